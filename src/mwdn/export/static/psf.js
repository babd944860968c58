// From the picture of a point source to a PSF, as `mwdn.Calibration.from_file`.
import { normalise, binPixels, cropCentre, flip, sizeText } from "./frames.js";
import { FileError } from "./png.js";

const SATURATED_PART = 1e-3;
const COLOURS = ["red", "green", "blue"];
// Whether rows and columns are swapped, then whether rows, then whether columns are reversed.
const TURNS = {
  "flip-left-right": [false, false, true], "flip-top-bottom": [false, true, false], "rotate-90": [true, true, false],
  "rotate-180": [false, true, true], "rotate-270": [true, false, true], transpose: [true, false, false], transverse: [true, true, true],
};
export const ORIENTATIONS = Object.keys(TURNS);

function refuseSaturated({ data, channels, maximum }, depth) {
  if (!(data instanceof Uint8Array || data instanceof Uint16Array)) return;
  const largest = data.reduce((a, b) => Math.max(a, b), 0);
  let limit = depth ? 2 ** depth - 1 : maximum;
  const bits = !depth && maximum === 65535 ? [10, 12, 14].find((each) => largest < 2 ** each) : undefined;
  if (largest && (largest > 0.98 * limit || (bits && largest === 2 ** bits - 1))) limit = largest;
  let count = 0;
  const pixels = data.length / channels;
  for (let pixel = 0; pixel < pixels; pixel += 1) {
    for (let channel = 0; channel < channels; channel += 1) {
      if (data[pixel * channels + channel] >= limit) {
        count += 1;
        break;
      }
    }
  }
  if (count > SATURATED_PART * pixels) throw new FileError(`is a saturated PSF: ${count} of ${pixels} pixels are at the maximum ${limit}. Lower the exposure and capture it again.`);
}

// The 5th percentile of each channel: a PSF is dark between its lines.
function subtractBackground(image) {
  const plane = image.width * image.height;
  const light = [];
  for (let channel = 0; channel < image.channels; channel += 1) {
    const values = image.data.subarray(channel * plane, (channel + 1) * plane);
    const level = Math.max(values.slice().sort()[Math.floor(0.05 * plane)], 0);
    let sum = 0;
    for (let pixel = 0; pixel < plane; pixel += 1) sum += values[pixel] = Math.max(values[pixel] - level, 0);
    if (!(sum > 0)) throw new FileError(`is an empty PSF: no light is left in ${image.channels === 1 ? "it" : COLOURS[channel]} above the background. Expose longer.`);
    for (let pixel = 0; pixel < plane; pixel += 1) values[pixel] /= sum;
    light.push(sum);
  }
  return light;
}

const transposed = (image) => ({
  width: image.height, height: image.width, channels: image.channels,
  data: image.data.map((_, index, data) => {
    const plane = image.width * image.height;
    const place = index % plane;
    return data[index - place + (place % image.height) * image.width + Math.floor(place / image.height)];
  }),
});

// Reversing an even length moves the centre n / 2 to n / 2 - 1: one step back.
function reverse(image, what) {
  const { width, height } = image;
  const [down, right] = [what.rows && height % 2 === 0 ? 1 : 0, what.columns && width % 2 === 0 ? 1 : 0];
  const flipped = flip(image, what);
  const data = flipped.data.map((_, index, all) => {
    const plane = width * height;
    const place = index % plane;
    const [y, x] = [Math.floor(place / width), place % width];
    return all[index - place + ((y - down + height) % height) * width + ((x - right + width) % width)];
  });
  return { ...flipped, data };
}

export function turn(image, orientation) {
  if (!orientation) return image;
  const [swap, rows, columns] = TURNS[orientation];
  return reverse(swap ? transposed(image) : image, { rows, columns });
}

// {psf: image of unit sums, light: sum of each channel}
export function toPsf(frame, { bit_depth, psf_gamma: gamma, bin, crop, orientation }, size) {
  refuseSaturated(frame, bit_depth);
  let image = normalise(frame, { bit_depth, gamma, bgr: false });
  image = binPixels(crop ? cropCentre(image, crop) : image, bin);
  const [height, width] = size;
  if (image.height !== height || image.width !== width) {
    const advice = `This page reconstructs ${height} x ${width}: correct “Bin” or “Crop” under “Format of the files”, or make a page for this size: mwdn export --web psf.png`;
    throw new FileError(`has ${sizeText(frame)} pixels${bin > 1 ? `, binned ${sizeText(image)}` : ""}. ${advice}`);
  }
  const light = subtractBackground(image);
  return { psf: turn(image, orientation), light };
}
