// PNG without the canvas, which has 8 bits and applies colour profiles: numbers as stored, as `mwdn.read_frame` reads them.

export class FileError extends Error {}

export const MAX_PIXELS = 2 ** 26;
const SIGNATURE = [137, 80, 78, 71, 13, 10, 26, 10];
const CHANNELS = { 0: 1, 2: 3, 3: 1, 4: 2, 6: 4 }; // by colour type
const DAMAGED = "is damaged or cut off. Save or copy it again.";
const CRC = Uint32Array.from({ length: 256 }, (_, byte) => {
  for (let bit = 0; bit < 8; bit += 1) byte = byte & 1 ? 0xedb88320 ^ (byte >>> 1) : byte >>> 1;
  return byte;
});

function checksum(bytes) {
  let crc = -1;
  for (const byte of bytes) crc = CRC[(crc ^ byte) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

export const isPng = (bytes) => SIGNATURE.every((byte, index) => bytes[index] === byte);

// At most `limit` bytes: a small file can hold gigabytes of zeros.
export async function inflate(bytes, limit, format = "deflate") {
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format)).getReader();
  const result = new Uint8Array(limit);
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return result.subarray(0, length);
    if (length + value.length > limit) throw new FileError(DAMAGED);
    result.set(value, length);
    length += value.length;
  }
}

function readChunks(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const chunks = [];
  for (let place = 8; place + 12 <= bytes.length; ) {
    const length = view.getUint32(place);
    if (place + 12 + length > bytes.length) break;
    const body = bytes.subarray(place + 4, place + 8 + length);
    if (checksum(body) !== view.getUint32(place + 8 + length)) break;
    const type = String.fromCharCode(...body.subarray(0, 4));
    if (type === "IEND") return chunks;
    chunks.push({ type, data: body.subarray(4) });
    place += 12 + length;
  }
  throw new FileError(DAMAGED);
}

// Each row is stored as its difference from a prediction: from the left a, from above b, from above left c.
function undoFilters(raw, rows, stride, step) {
  const result = new Uint8Array(rows * stride);
  for (let row = 0; row < rows; row += 1) {
    const kind = raw[row * (stride + 1)];
    if (kind > 4) throw new FileError(DAMAGED);
    const start = row * stride;
    for (let column = 0; column < stride; column += 1) {
      const a = column < step ? 0 : result[start + column - step];
      const b = row ? result[start + column - stride] : 0;
      let guess = 0;
      if (kind === 1) guess = a;
      else if (kind === 2) guess = b;
      else if (kind === 3) guess = (a + b) >> 1;
      else if (kind === 4) {
        const c = row && column >= step ? result[start + column - stride - step] : 0;
        const [da, db, dc] = [Math.abs(b - c), Math.abs(a - c), Math.abs(a + b - 2 * c)];
        guess = da <= db && da <= dc ? a : db <= dc ? b : c;
      }
      result[start + column] = raw[row * (stride + 1) + 1 + column] + guess;
    }
  }
  return result;
}

// Samples of 1, 2, 4, 8 or 16 bits, one number each.
function unpackSamples(bytes, { width, height, depth, stored, stride }) {
  if (depth === 8) return bytes;
  const result = depth === 16 ? new Uint16Array(width * height * stored) : new Uint8Array(width * height * stored);
  const count = width * stored;
  for (let row = 0; row < height; row += 1) {
    for (let index = 0; index < count; index += 1) {
      const bit = index * depth;
      const byte = row * stride + (bit >> 3);
      result[row * count + index] = depth === 16
        ? 256 * bytes[byte] + bytes[byte + 1]
        : (bytes[byte] >> (8 - depth - (bit & 7))) & ((1 << depth) - 1);
    }
  }
  return result;
}

// Grey and colours without the alpha channel, which must be opaque; fewer than 8 bits spread over 8.
function pickColours(samples, { stored, colour, depth }, palette) {
  if (colour === 3) return { channels: 3, data: Uint8Array.from({ length: 3 * samples.length }, (_, i) => palette[3 * samples[Math.floor(i / 3)] + (i % 3)]) };
  if (depth < 8) return { channels: 1, data: samples.map((value) => (value * 255) / (2 ** depth - 1)) };
  if (colour < 4) return { channels: stored, data: samples };
  const channels = stored - 1;
  const data = new samples.constructor((samples.length / stored) * channels);
  for (let pixel = 0; pixel * stored < samples.length; pixel += 1) {
    if (samples[pixel * stored + channels] !== 2 ** depth - 1) throw new FileError("has transparent pixels. Save it without an alpha channel.");
    for (let channel = 0; channel < channels; channel += 1) data[pixel * channels + channel] = samples[pixel * stored + channel];
  }
  return { channels, data };
}

// {width, height, channels: 1 or 3, data: interleaved numbers, maximum: 255 or 65535}
export async function decodePng(bytes) {
  const chunks = readChunks(bytes);
  if (chunks[0]?.type !== "IHDR" || chunks[0].data.length !== 13) throw new FileError(DAMAGED);
  const header = chunks[0].data;
  const view = new DataView(header.buffer, header.byteOffset);
  const [width, height] = [view.getUint32(0), view.getUint32(4)];
  const [depth, colour, , , interlaced] = header.subarray(8);
  if (!(colour in CHANNELS) || ![1, 2, 4, 8, 16].includes(depth) || !width || !height) throw new FileError(DAMAGED);
  if (interlaced) throw new FileError("is an interlaced PNG. Save it without interlacing.");
  if (width * height > MAX_PIXELS) throw new FileError(`has ${width} × ${height} pixels, more than ${MAX_PIXELS / 2 ** 20} million. Bin or crop it.`);
  const stored = CHANNELS[colour];
  const stride = Math.ceil((width * stored * depth) / 8);
  const parts = chunks.filter(({ type }) => type === "IDAT").map(({ data }) => data);
  const packed = new Uint8Array(await new Blob(parts).arrayBuffer());
  const length = height * (stride + 1);
  // deflate packs at most 1,032 to 1
  if (length > 1100 * packed.length) throw new FileError(DAMAGED);
  let raw;
  try {
    raw = await inflate(packed, length);
  } catch {
    throw new FileError(DAMAGED);
  }
  if (raw.length !== length) throw new FileError(DAMAGED);
  const shape = { width, height, depth, colour, stored, stride };
  const rows = undoFilters(raw, height, stride, Math.max(1, (stored * depth) >> 3));
  const palette = chunks.find(({ type }) => type === "PLTE")?.data;
  if (colour === 3 && !palette) throw new FileError(DAMAGED);
  return { width, height, ...pickColours(unpackSamples(rows, shape), shape, palette), maximum: depth === 16 ? 65535 : 255 };
}

function chunk(type, data) {
  const bytes = new Uint8Array(12 + data.length);
  const view = new DataView(bytes.buffer);
  view.setUint32(0, data.length);
  bytes.set([...type].map((letter) => letter.charCodeAt(0)), 4);
  bytes.set(data, 8);
  view.setUint32(8 + data.length, checksum(bytes.subarray(4, 8 + data.length)));
  return bytes;
}

// `pixels`: planes of numbers in [0, 1], already encoded for viewing.
export async function encodePng({ width, height, channels, data }, bits) {
  const maximum = 2 ** bits - 1;
  const stride = (width * channels * bits) / 8;
  const raw = new Uint8Array(height * (stride + 1));
  let place = 0;
  for (let row = 0; row < height; row += 1) {
    raw[place++] = 0;
    for (let column = 0; column < width; column += 1) {
      for (let channel = 0; channel < channels; channel += 1) {
        const value = Math.round(data[(channel * height + row) * width + column] * maximum);
        if (bits === 16) raw[place++] = value >> 8;
        raw[place++] = value & 255;
      }
    }
  }
  const header = new Uint8Array(13);
  new DataView(header.buffer).setUint32(0, width);
  new DataView(header.buffer).setUint32(4, height);
  header.set([bits, channels === 3 ? 2 : 0, 0, 0, 0], 8);
  const packed = await new Response(new Blob([raw]).stream().pipeThrough(new CompressionStream("deflate"))).arrayBuffer();
  const parts = [new Uint8Array(SIGNATURE), chunk("IHDR", header), chunk("sRGB", new Uint8Array(1)), chunk("IDAT", new Uint8Array(packed)), chunk("IEND", new Uint8Array())];
  return new Blob(parts, { type: "image/png" });
}
