// The package's messages name options of its command line and of Python; on this page they have controls.

const NAMES = {
  align: "Fit turn and scale of the PSF to the capture",
  ambient: "Light of the room",
  background: "the background of the PSF, which this page estimates",
  bin: "Bin",
  bit_depth: "Bits of the sensor",
  crop: "a crop of the frames, before they are dropped here",
  dark: "a dark frame, subtracted before the frames are dropped here",
  gamma: "Encoding of the capture",
  grey: "grey files of both",
  hot_pixels: "hot pixels, corrected before the frames are dropped here",
  iterations: "iterations",
  method: "Method",
  mosaic: "Colour filters of raw frames",
  psf_bin: "Bin of the PSF",
  psf_gamma: "Encoding of the PSF",
  psf_orientation: "Turn the PSF",
  regularisation: "regularisation",
  white_balance: "White balance",
};
const CONTROLS = new Set(["align", "ambient", "bin", "bit_depth", "gamma", "method", "mosaic", "psf_bin", "psf_gamma", "psf_orientation", "white_balance"]);
const VALUES = { FILE: "a frame of it", "@FILE": "a frame of it", srgb: "sRGB", None: "none", True: "", true: "" };

function control(name, value = "") {
  const key = name.replaceAll("-", "_");
  if (!(key in NAMES)) return null;
  if (!CONTROLS.has(key)) return NAMES[key];
  const text = value.replace(/^["'(]|["')]$/g, "");
  const shown = VALUES[text] ?? text;
  return shown ? `“${NAMES[key]}”: ${shown}` : `“${NAMES[key]}”`;
}

// Each option of a line, or null if the page has no words for one.
function controls(line, between, equals) {
  const words = line.split(between).map((option) => {
    const [name, ...values] = option.split(equals);
    return control(name, values.join(equals));
  });
  return words.includes(null) ? null : words.join(", ");
}

// Likewise, of `{"bin": 2, "psf_bin": 1}`.
function fromJson(json) {
  try {
    const words = Object.entries(JSON.parse(json)).map(([name, value]) => control(name, String(value)));
    return words.includes(null) ? null : words.join(", ");
  } catch {
    return null;
  }
}

// "Try `--gamma srgb`." becomes "Try “Encoding of the capture”: sRGB."
export function pageWords(text) {
  return text
    .replace(/`--([a-z][^`]*)`/g, (all, line) => controls(line, " --", " ") ?? all)
    .replace(/`([a-z_]+=[^`]*)`/g, (all, line) => controls(line, /, (?=[a-z_]+=)/, "=") ?? all)
    .replace(/`(?:calibration=|options=)?(\{"[^`]*\})`/g, (all, json) => fromJson(json) ?? all);
}
