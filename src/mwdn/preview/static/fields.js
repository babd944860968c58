// What the form of the page says, as fields of requests.
import { readSliders } from "./sliders.js";

const byId = (id) => document.getElementById(id);
export const UPLOAD = ""; // the camera of the PSF that was dropped
const ROOM_LIGHT = { "": null, true: true, false: false, frame: false }; // of the live picture, by the choice
export const ORIENTATIONS = [
  "rotate-180", "rotate-90", "rotate-270", "flip-left-right", "flip-top-bottom", "transpose", "transverse",
];
export const chosen = { psf: null, capture: null, ambient: null, job: null };

export function calibration() {
  const options = {};
  if (byId("bin").value && byId("bin").value !== "1") options.bin = Number(byId("bin").value);
  if (byId("psf-bin").value) options.psf_bin = Number(byId("psf-bin").value);
  if (byId("bit-depth").value) options.bit_depth = Number(byId("bit-depth").value);
  if (byId("mosaic").value) options.mosaic = byId("mosaic").value;
  if (byId("gamma").value) options.gamma = byId("gamma").value;
  if (byId("psf-gamma").value) options.psf_gamma = byId("psf-gamma").value;
  if (byId("orientation").value) options.psf_orientation = byId("orientation").value;
  return Object.keys(options).length ? JSON.stringify(options) : "";
}

export function cameraFields() {
  const name = byId("camera").value;
  return name === UPLOAD ? { psf: chosen.psf, calibration: calibration() } : { camera: name };
}

export function whatIsMissing() {
  if (!chosen.capture) return "Drop a capture, or choose a sample.";
  if (byId("camera").value === UPLOAD && !chosen.psf) return "Drop a PSF, or choose a calibration.";
  if (byId("room-light").value === "frame" && !chosen.ambient) return "Drop a frame of the room’s light alone.";
  return "";
}

export function orderFields(method = byId("method").value, trust = byId("trust").checked) {
  const options = method === byId("method").value ? readSliders() : {};
  const align = byId("align").checked ? "true" : "";
  const room = byId("room-light").value;
  const light = room === "frame" ? { room_light: "false", ambient: chosen.ambient } : { room_light: room };
  const fields = { ...cameraFields(), ...light, capture: chosen.capture, method, align, trust: String(trust) };
  return { ...fields, options: JSON.stringify(options) };
}

// What all viewers of the live picture share.
export const liveSettings = () => ({
  method: byId("method").value, options: readSliders(),
  align: byId("align").checked || null, room_light: ROOM_LIGHT[byId("room-light").value],
  stops: Number(byId("exposure").value), white_balance: byId("balance").value,
});

export const look = (format = "png") =>
  `?format=${format}&exposure=${byId("exposure").value}&white_balance=${byId("balance").value}`;
