// Hot pixels of a capture, from the capture alone, as `mwdn.calibration.isolated_pixels`.
const ISOLATED = [4, 8];
const MAX_ISOLATED = 2e-3;
const SAMPLED = 2 ** 15;

// The pixels of one colour, and of one place in the cell of a mosaic: {at(y, x), place(y, x), width, height}.
function planesOf(image, cell) {
  const planes = [];
  const [width, height] = [image.width / cell, image.height / cell];
  for (let start = 0; start < image.data.length; start += image.width * image.height) {
    for (let corner = 0; corner < cell ** 2; corner += 1) {
      const place = (y, x) => (y * cell + Math.floor(corner / cell)) * image.width + x * cell + (corner % cell);
      planes.push({ width, height, place, at: (y, x) => image.data[start + place(y, x)] });
    }
  }
  return planes;
}

// Variance of the noise, by the mixed second difference of 2 x 2 pixels, as `mwdn.optics.noise.noise_level`.
function noiseVariance({ at, width, height }) {
  const [rows, columns] = [height, width].map((length) => Math.max(1, Math.min(16, Math.floor((length - 1) / 16))));
  const [high, wide] = [Math.floor((height - 1) / rows), Math.floor((width - 1) / columns)];
  const step = Math.max(1, Math.floor((rows * columns * high * wide) / SAMPLED));
  let sum = 0;
  for (let part = 0; part < rows * columns; part += 1) {
    const [top, left] = [Math.floor(part / columns) * high, (part % columns) * wide];
    const sample = new Float32Array(Math.ceil((high * wide) / step)).map((_, number) => {
      const [y, x] = [top + Math.floor((number * step) / wide), left + ((number * step) % wide)];
      return Math.abs(at(y + 1, x + 1) - at(y, x + 1) - at(y + 1, x) + at(y, x));
    });
    sum += (sample.sort()[Math.floor((sample.length - 1) / 2)] / (2 * 0.6745)) ** 2;
  }
  return sum / (rows * columns);
}

// Second largest of the eight neighbours; outside the image the nearest pixels count.
function secondAround({ at, width, height }, y, x) {
  let [first, second] = [-Infinity, -Infinity];
  for (let row = y - 1; row <= y + 1; row += 1) {
    for (let column = x - 1; column <= x + 1; column += 1) {
      if (row === y && column === x) continue;
      const value = at(Math.min(Math.max(row, 0), height - 1), Math.min(Math.max(column, 0), width - 1));
      if (value > first) [first, second] = [value, first];
      else if (value > second) second = value;
    }
  }
  return second;
}

// Each hot pixel, hot in any colour, with its good neighbours of the same colour, as `PixelRepair`.
export function findHotPixels(image, cell) {
  if (Math.min(image.width, image.height) < 2 * cell || image.width % cell || image.height % cell) return [];
  const planes = planesOf(image, cell);
  const mean = Math.max(image.data.reduce((sum, value) => sum + value, 0) / image.data.length, 1e-12);
  const noise = Math.sqrt(planes.reduce((sum, plane) => sum + noiseVariance(plane), 0) / planes.length);
  const hot = new Set();
  let [suspected, count] = [0, 0];
  for (const plane of planes) {
    for (let y = 0; y < plane.height; y += 1) {
      for (let x = 0; x < plane.width; x += 1) {
        const level = secondAround(plane, y, x);
        const deviation = Math.max(noise * Math.sqrt(Math.max(level / mean, 1)), 1e-12);
        const excess = (plane.at(y, x) - level) / deviation;
        if (excess > ISOLATED[0]) suspected += 1;
        if (excess > ISOLATED[1]) {
          count += 1;
          hot.add(plane.place(y, x));
        }
      }
    }
  }
  if (count < suspected / 2 || count > MAX_ISOLATED * image.data.length) return [];
  return [...hot].map((pixel) => [pixel, goodNeighbours(pixel, hot, image, cell)]);
}

// The nearest of them: rings of growing size are searched.
function goodNeighbours(pixel, hot, { width, height }, cell) {
  const [row, column] = [Math.floor(pixel / width), pixel % width];
  for (let ring = 1; ring <= 3; ring += 1) {
    const good = [];
    for (let down = -ring; down <= ring; down += 1) {
      for (let right = -ring; right <= ring; right += 1) {
        const [y, x] = [row + down * cell, column + right * cell];
        const isRing = Math.max(Math.abs(down), Math.abs(right)) === ring;
        if (isRing && y >= 0 && y < height && x >= 0 && x < width && !hot.has(y * width + x)) good.push(y * width + x);
      }
    }
    if (good.length) return good;
  }
  return [];
}
