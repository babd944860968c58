// NPY: numpy's arrays, (H, W) or (H, W, 1 or 3).
import { FileError, MAX_PIXELS } from "./png.js";

const TYPES = { "|u1": Uint8Array, "<u2": Uint16Array, "<f4": Float32Array, "<f8": Float64Array };

export const isNpy = (bytes) => bytes[0] === 0x93 && String.fromCharCode(...bytes.subarray(1, 6)) === "NUMPY";

export function decodeNpy(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const wide = bytes[6] > 1;
  if (bytes.length < 16) throw new FileError("is cut off. Copy it again.");
  const start = wide ? 12 : 10;
  const end = start + (wide ? view.getUint32(8, true) : view.getUint16(8, true));
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, Math.min(end, start + 4096)));
  const kind = /'descr': '([^']*)'/.exec(header)?.[1];
  const shape = (/'shape': \(([^)]*)\)/.exec(header)?.[1] ?? "").split(",").filter((text) => text.trim()).map(Number);
  while (shape.length > 3 && shape[0] === 1) shape.shift();
  const [height, width, channels = 1] = shape;
  const axes = `${kind} (${shape.join(", ")})`;
  if (!(kind in TYPES) || /'fortran_order': True/.test(header) || ![2, 3].includes(shape.length) || ![1, 3].includes(channels)) {
    throw new FileError(`holds an array ${axes}, which must be uint8, uint16, float32 or float64 in C order, (height, width) or (height, width, 1 or 3).`);
  }
  const Numbers = TYPES[kind];
  const length = height * width * channels;
  if (!length || height * width > MAX_PIXELS || bytes.length < end + length * Numbers.BYTES_PER_ELEMENT) throw new FileError(`is cut off or too large: ${axes}.`);
  const data = new Numbers(bytes.slice(end, end + length * Numbers.BYTES_PER_ELEMENT).buffer);
  if (!data.every(Number.isFinite)) throw new FileError("holds numbers that are not finite.");
  return { width, height, channels, data, maximum: { "|u1": 255, "<u2": 65535 }[kind] ?? 1 };
}

// Planes of float32 as (H, W, C).
export function encodeNpy({ width, height, channels, data }) {
  const pixels = new Float32Array(data.length);
  const plane = width * height;
  for (let channel = 0; channel < channels; channel += 1) {
    for (let pixel = 0; pixel < plane; pixel += 1) pixels[pixel * channels + channel] = data[channel * plane + pixel];
  }
  const text = `{'descr': '<f4', 'fortran_order': False, 'shape': (${height}, ${width}, ${channels}), }`;
  const header = text.padEnd(128 - 10 - 1) + "\n";
  const start = [0x93, ...[..."NUMPY"].map((letter) => letter.charCodeAt(0)), 1, 0, header.length, 0];
  return new Blob([new Uint8Array(start), header, pixels], { type: "application/octet-stream" });
}
