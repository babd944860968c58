// Pictures for people, as `mwdn.to_display` and `mwdn.write_picture`.

const linearToSrgb = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

// Gains of the colours, that of green being 1, as `mwdn.calibration.white_balance`.
function gains({ channels, data }, balance, light) {
  if (channels !== 3 || !balance) return [1, 1, 1];
  if (Array.isArray(balance)) return balance.map((gain) => gain / balance[1]);
  const plane = data.length / 3;
  const mean = (channel) => data.subarray(channel * plane, (channel + 1) * plane).reduce((sum, value) => sum + Math.max(value, 0), 0);
  const colour = balance === "psf" ? light : [0, 1, 2].map(mean);
  return colour.map((value) => (value > 0 && colour[1] > 0 ? colour[1] / value : 1));
}

export function applyWhiteBalance(image, balance, light) {
  const factors = gains(image, balance, light);
  const plane = image.width * image.height;
  return { ...image, data: image.data.map((value, index) => value * factors[Math.floor(index / plane)]) };
}

// All but the brightest 0.3 % within [0, 1], then the exposure in stops, then sRGB.
export function toDisplay(image, stops = 0) {
  const sorted = image.data.slice().sort();
  const brightest = Math.max(sorted[sorted.length - Math.floor(0.003 * sorted.length) - 1], 1e-12);
  const data = image.data.map((value) => linearToSrgb(Math.min(Math.min(Math.max(value / brightest, 0), 1) * 2 ** stops, 1)));
  return { ...image, data };
}
