// From the numbers of a raw frame to a measurement, as `mwdn.calibration.FrameFormat.to_measurement`.
// Images are planes: {width, height, channels, data: Float32Array (channels, height, width)}.
import { findHotPixels } from "./hot_pixels.js";
import { decodeNpy, isNpy } from "./npy.js";
import { decodePng, FileError, isPng } from "./png.js";

const MAX_BYTES = 2 ** 29;

export async function readFrame(file) {
  if (file.size > MAX_BYTES) throw new FileError(`has ${Math.round(file.size / 1e6)} MB, more than ${Math.round(MAX_BYTES / 1e6)}.`);
  const bytes = new Uint8Array(await file.arrayBuffer());
  if (isPng(bytes)) return decodePng(bytes);
  if (isNpy(bytes)) return decodeNpy(bytes);
  throw new FileError("is neither PNG nor NPY. Save the raw frame as PNG of 8 or 16 bits, not as JPEG, which loses what is faint.");
}

const srgbToLinear = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);

function decodeGamma(gamma) {
  if (gamma === null) return (x) => x;
  return gamma === "srgb" ? srgbToLinear : (x) => Math.max(x, 0) ** gamma;
}

// Light from 0 to 1: 1 is the largest number of the sensor.
export function normalise(frame, { bit_depth: depth, gamma, bgr }) {
  const { width, height, channels, data } = frame;
  const isFloat = data instanceof Float32Array || data instanceof Float64Array;
  const largest = data.reduce((a, b) => Math.max(a, b), 0);
  const scale = depth ? 2 ** depth - 1 : frame.maximum;
  if (!isFloat && depth && scale > frame.maximum) throw new FileError(`has numbers up to ${frame.maximum}; ${depth} bits need up to ${scale}.`);
  if (largest > scale * (isFloat ? 1.5 : 1)) throw new FileError(`holds the number ${largest}, above ${scale}. Correct the bit depth under “Format of the files”.`);
  const decode = decodeGamma(gamma);
  const plane = width * height;
  const image = new Float32Array(data.length);
  for (let channel = 0; channel < channels; channel += 1) {
    const from = bgr ? channels - 1 - channel : channel;
    for (let pixel = 0; pixel < plane; pixel += 1) image[channel * plane + pixel] = decode(data[pixel * channels + from] / scale);
  }
  return { width, height, channels, data: image };
}

export const sizeText = ({ width, height }) => `${height} x ${width}`;

// Combine with an image of the same size, of as many channels or one.
function combine(image, other, what, operation) {
  if (!other) return image;
  if (other.width !== image.width || other.height !== image.height || ![1, image.channels].includes(other.channels)) {
    throw new FileError(`has ${sizeText(image)} pixels, but ${what} of this camera has ${sizeText(other)}. Use raw frames of this camera.`);
  }
  return { ...image, data: image.data.map((value, index) => operation(value, other.data[index % other.data.length])) };
}

// As `FrameFormat.saturated`: sensors of 10, 12 or 14 bits may use the lower bits of 16.
function isSaturated({ data, maximum }, depth) {
  if (data instanceof Float32Array || data instanceof Float64Array) return false;
  const largest = data.reduce((a, b) => Math.max(a, b), 0);
  if (!depth && maximum === 65535 && [1023, 4095, 16383].includes(largest)) return true;
  return largest > 0.98 * (depth ? 2 ** depth - 1 : maximum);
}

// Least saturated value of a plane if it has a plateau at its maximum, as `mwdn.optics.saturation.saturated_pixels`.
function plateauOf(values, width) {
  const most = values.reduce((a, b) => Math.max(a, b), -Infinity);
  const [low, high] = [0.98, 0.995].map((part) => Math.fround(Math.fround(part) * most));
  const sample = values.filter((_, place) => (place % width) % 2 === 0);
  const above = sample.filter((value) => value >= low).length;
  const at = sample.filter((value) => value >= high).length;
  return at > above - at && above > at && at >= 5e-4 * sample.length ? high : Infinity;
}

// Saturated pixels of a corrected image become a plateau again, as `mwdn.optics.saturation.keep_plateau`.
function keepPlateau(saturating, corrected) {
  if (corrected === saturating) return corrected; // nothing was corrected
  const { width, height, channels } = corrected;
  const plane = width * height;
  const data = corrected.data.slice();
  const aroundOf = (place) => {
    const [y, x] = [Math.floor(place / width), place % width];
    const places = [];
    for (let row = Math.max(y - 1, 0); row <= Math.min(y + 1, height - 1); row += 1) {
      for (let column = Math.max(x - 1, 0); column <= Math.min(x + 1, width - 1); column += 1) places.push(row * width + column);
    }
    return places;
  };
  for (let channel = 0; channel < channels; channel += 1) {
    const [before, after] = [saturating, corrected].map((image) => image.data.subarray(channel * plane, (channel + 1) * plane));
    const least = plateauOf(before, width);
    const known = before.map((value, place) => value >= least && after[place] !== value && after[place] > value / 2
      && aroundOf(place).filter((near) => before[near] >= least).length > 1);
    let bound = Infinity;
    known.forEach((isKnown, place) => {
      if (isKnown) bound = Math.min(bound, aroundOf(place).reduce((most, near) => (known[near] ? Math.max(most, after[near]) : most), -Infinity));
    });
    for (let place = 0; place < plane; place += 1) data[channel * plane + place] = Math.min(after[place], bound);
  }
  return { ...corrected, data };
}

// Hot pixels become the mean of good neighbours: pairs of a pixel and its neighbours.
function repair(image, hotPixels) {
  const plane = image.width * image.height;
  const data = image.data.slice();
  for (const [pixel, neighbours] of hotPixels) {
    for (let start = 0; start < data.length; start += plane) {
      data[start + pixel] = neighbours.reduce((sum, place) => sum + image.data[start + place], 0) / Math.max(neighbours.length, 1);
    }
  }
  return { ...image, data };
}

function pick(image, [width, height], source) {
  const data = new Float32Array(image.channels * width * height);
  let place = 0;
  for (let channel = 0; channel < image.channels; channel += 1) {
    for (let y = 0; y < height; y += 1) {
      for (let x = 0; x < width; x += 1) data[place++] = image.data[(channel * image.height + source.row(y)) * image.width + source.column(x)];
    }
  }
  return { width, height, channels: image.channels, data };
}

// The centre (height // 2, width // 2) stays the centre; cells of a mosaic stay whole.
export function cropCentre(image, [height, width], cell = 1) {
  if (height > image.height || width > image.width) {
    throw new FileError(`has ${sizeText(image)} pixels, fewer than the part to use, ${height} x ${width}.`);
  }
  const start = (length, kept) => (Math.floor(Math.floor(length / cell) / 2) - Math.floor(Math.floor(kept / cell) / 2)) * cell;
  const [top, left] = [start(image.height, height), start(image.width, width)];
  return pick(image, [width, height], { row: (y) => top + y, column: (x) => left + x });
}

// Each 2 x 2 cell becomes a pixel, its two greens averaged.
function demosaic(image, mosaic) {
  if (image.channels !== 1 || image.width % 2 || image.height % 2) {
    throw new FileError(`has ${sizeText(image)} pixels of ${image.channels} channels; this camera's raw frames have one channel with a mosaic (${mosaic}) and even sides.`);
  }
  const size = [image.width / 2, image.height / 2];
  const parts = [0, 1, 2, 3].map((place) => pick(image, size, { row: (y) => 2 * y + (place >> 1), column: (x) => 2 * x + (place & 1) }));
  const colours = [..."rgb"].map((letter) => parts.filter((_, place) => mosaic[place] === letter));
  const plane = size[0] * size[1];
  const data = Float32Array.from({ length: 3 * plane }, (_, index) => {
    const same = colours[Math.floor(index / plane)];
    return same.reduce((sum, part) => sum + part.data[index % plane], 0) / same.length;
  });
  return { width: size[0], height: size[1], channels: 3, data };
}

export function averageColours(image) {
  const plane = image.width * image.height;
  const data = Float32Array.from({ length: plane }, (_, pixel) => {
    let sum = 0;
    for (let start = pixel; start < image.data.length; start += plane) sum += image.data[start];
    return sum / image.channels;
  });
  return { ...image, channels: 1, data };
}

// Blocks are averaged; the block that holds the centre becomes the centre.
export function binPixels(image, factor) {
  if (factor === 1) return image;
  if (factor > Math.min(image.width, image.height)) throw new FileError(`has ${sizeText(image)} pixels, too few to bin by ${factor}.`);
  const [height, width] = [image.height, image.width].map((length) => Math.floor(length / factor));
  const start = (length, blocks) => Math.min(Math.max(Math.floor(length / 2) - Math.floor(blocks / 2) * factor, 0), length - blocks * factor);
  const [top, left] = [start(image.height, height), start(image.width, width)];
  const data = new Float32Array(image.channels * width * height);
  let place = 0;
  for (let channel = 0; channel < image.channels; channel += 1) {
    for (let y = 0; y < height; y += 1) {
      for (let x = 0; x < width; x += 1) {
        let sum = 0;
        for (let dy = 0; dy < factor; dy += 1) {
          const row = (channel * image.height + top + y * factor + dy) * image.width + left + x * factor;
          for (let dx = 0; dx < factor; dx += 1) sum += image.data[row + dx];
        }
        data[place++] = sum / factor ** 2;
      }
    }
  }
  return { width, height, channels: image.channels, data };
}

export function flip(image, { rows = false, columns = false }) {
  const { width, height } = image;
  return pick(image, [width, height], { row: (y) => (rows ? height - 1 - y : y), column: (x) => (columns ? width - 1 - x : x) });
}

export function toMeasurement(frame, format) {
  const light = normalise(frame, format);
  let image = combine(light, format.offset, "the dark or ambient frame", (value, dark) => value - dark);
  if (isSaturated(frame, format.bit_depth)) image = keepPlateau(light, image);
  image = keepPlateau(image, combine(image, format.flat, "the flat field", (value, flat) => value / flat));
  // Without a map, which is null, they are sought; a sample, which has no such key, is a measurement already.
  const hot = format.hot_pixels === null ? findHotPixels(image, format.mosaic ? 2 : 1) : format.hot_pixels ?? [];
  if (hot.length) image = repair(image, hot);
  if (format.crop) image = cropCentre(image, format.crop, format.mosaic ? 2 : 1);
  if (format.mosaic) image = demosaic(image, format.mosaic);
  if (format.grey && image.channels > 1) image = averageColours(image);
  image = binPixels(image, format.bin);
  if (format.upside_down) image = flip(image, { rows: true });
  image = combine(image, format.stray, "the stray light", (value, stray) => value - stray);
  return combine(image, format.field, "the sensor's field", (value, field) => value / field);
}
