// The page: captures become pictures in this browser, nothing leaves it.
import { setUpDivider, setPicture } from "./divider.js";
import { applyWhiteBalance, toDisplay } from "./display.js";
import { setUpDropZone } from "./dropping.js";
import { averageColours, readFrame, sizeText, toMeasurement } from "./frames.js";
import { agreement, openNetwork, PageError, unpack } from "./network.js";
import { encodeNpy } from "./npy.js";
import { encodePng, FileError } from "./png.js";
import { ORIENTATIONS, toPsf } from "./psf.js";
import { saveBlob } from "./saving.js";

const byId = (id) => document.getElementById(id);
const camera = globalThis.mwdnCamera;
const [HEIGHT, WIDTH] = camera.size;
const RAW = { bit_depth: null, gamma: null, bgr: false, bin: 1 };

const own = { psf: null, light: camera.light, format: null }; // the camera of this page
let dropped = null; // {name, frame} of a PSF that replaces it
let captures = []; // {name, frame, isSample}
let shown = null; // {name, measurement, scene, light}
let network = null;
let prepared = null; // PSF that the network has prepared
let queue = Promise.resolve();
let due = 0;

function say(text, wrong = false) {
  byId("state").textContent = text;
  byId("state").classList.toggle("wrong", wrong);
}

// Work is done one after the other; a failed piece is named and the next goes on.
function enqueue(work) {
  queue = queue.then(async () => {
    byId("bar").classList.add("busy");
    try {
      await work();
    } catch (error) {
      say(error instanceof FileError || error instanceof PageError ? error.message : `The page failed: ${error.message}`, true);
    } finally {
      byId("bar").classList.remove("busy");
    }
  });
  return queue;
}

// Names the file in an error about it.
async function about(name, work) {
  try {
    return await work();
  } catch (error) {
    if (error instanceof FileError) throw new FileError(`${name} ${error.message}`);
    throw error;
  }
}

// The browser draws what was said before a computation blocks it.
const painted = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));

function gammaOf(id) {
  const text = byId(id).value;
  return text === "" || text === "srgb" ? text || null : Number(text);
}

function chosenFormat() {
  const bit_depth = Number(byId("depth").value) || null;
  const bin = Math.max(1, Math.round(Number(byId("bin").value) || 1));
  return { ...RAW, hot_pixels: null, bit_depth, bin, gamma: gammaOf("gamma"), crop: byId("crop").checked ? [HEIGHT * bin, WIDTH * bin] : null };
}

function captureFormat(capture) {
  if (capture.isSample) return RAW;
  return dropped ? chosenFormat() : own.format;
}

function currentPsf() {
  if (!dropped) return own;
  const format = { ...chosenFormat(), psf_gamma: gammaOf("psf-gamma"), orientation: byId("orientation").value };
  const key = JSON.stringify(format);
  if (dropped.key !== key) Object.assign(dropped, { key, psf: toPsf(dropped.frame, format, camera.size) });
  return dropped.psf;
}

async function measure(capture, psf) {
  const measurement = toMeasurement(capture.frame, captureFormat(capture));
  if (measurement.width !== WIDTH || measurement.height !== HEIGHT) {
    const advice = dropped ? "Correct “Bin” or “Crop” under “Format of the files”." : "Use raw frames of this camera, or drop the PSF of yours.";
    const binned = sizeText(measurement) === sizeText(capture.frame) ? "" : `, ${sizeText(measurement)} as a measurement`;
    throw new FileError(`has ${sizeText(capture.frame)} pixels${binned}, but the PSF has ${sizeText(psf)}. ${advice}`);
  }
  if (measurement.channels === 1 && psf.channels === 3) throw new FileError("is grey, but the PSF has colours. Use raw frames of the same camera.");
  if (!(measurement.data.some((value) => value > 0))) throw new FileError("holds no light.");
  return measurement;
}

async function preparePsf({ psf }) {
  if (prepared === psf) return;
  say("Preparing the PSF …");
  await painted();
  await network.setPsf(psf, camera.channels);
  prepared = psf;
}

async function solve(candidate, measurement) {
  const scene = await candidate.reconstruct(measurement, camera.channels);
  return measurement.channels === 1 && scene.channels > 1 ? averageColours(scene) : scene;
}

async function reconstruct(capture) {
  if (!network) throw new PageError("The network is not loaded; see above.");
  const used = await about(dropped?.name, async () => currentPsf());
  const measurement = await about(capture.name, () => measure(capture, used.psf));
  await preparePsf(used);
  say(`Reconstructing ${capture.name} …`);
  await painted();
  const start = performance.now();
  const scene = await solve(network, measurement);
  const seconds = (performance.now() - start) / 1000;
  shown = { name: capture.name, measurement, scene, light: used.light, seconds };
  await show(true);
  say(`${capture.name}: ${WIDTH} × ${HEIGHT} pixels in ${seconds.toFixed(2)} s by ${network.name}, on this computer.`);
}

function balanced() {
  const choice = byId("balance").value;
  return applyWhiteBalance(shown.scene, choice === "camera" ? camera.white_balance : choice, shown.light);
}

const picture = (bits) => encodePng(toDisplay(balanced(), Number(byId("exposure").value)), bits);

async function show(both = false) {
  if (!shown) return;
  byId("view").hidden = false;
  if (both) await setPicture(byId("measurement"), await encodePng(toDisplay(shown.measurement), 8));
  await setPicture(byId("scene"), await picture(8));
}

async function save(extension, make) {
  if (shown) saveBlob(await make(), `${shown.name.replace(/\.[^.]*$/, "")}-scene${extension}`);
}

function choose(capture) {
  for (const button of document.querySelectorAll("#samples button, #captures button")) button.setAttribute("aria-pressed", String(button.dataset.name === capture.name && (button.parentElement.id === "samples") === Boolean(capture.isSample)));
  byId("chosen").dataset.current = captures.indexOf(capture);
  return enqueue(() => reconstruct(capture));
}

// The chosen capture, after a change of its camera; a sample is of the camera of this page only.
function again() {
  const capture = captures[Number(byId("chosen").dataset.current)];
  if (capture && !(dropped && capture.isSample)) return choose(capture);
  return dropped && enqueue(async () => {
    await about(dropped.name, async () => currentPsf());
    say(`${dropped.name} is the PSF. Drop captures of its camera.`);
  });
}

function addButton(place, capture) {
  const button = Object.assign(document.createElement("button"), { type: "button", textContent: capture.name });
  button.dataset.name = capture.name;
  button.setAttribute("aria-pressed", "false");
  button.onclick = () => {
    if (capture.isSample) useOwnCamera();
    choose(capture);
  };
  place.append(button);
}

async function takeCaptures(files) {
  const taken = [];
  const wrong = [];
  for (const file of files) {
    try {
      taken.push({ name: file.name, frame: await about(file.name, () => readFrame(file)) });
    } catch (error) {
      wrong.push(error.message);
    }
  }
  if (taken.length) {
    captures = [...captures.filter(({ isSample }) => isSample), ...taken];
    byId("captures").replaceChildren();
    byId("chosen").hidden = false;
    byId("capture-name").textContent = taken.length === 1 ? taken[0].name : `${taken.length} captures`;
    byId("capture-name").parentElement.classList.add("full");
    for (const capture of taken) addButton(byId("captures"), capture);
    await choose(taken[0]);
  }
  if (wrong.length) enqueue(() => { throw new FileError(wrong.join(" ")); });
}

async function takePsf([file]) {
  dropped = { name: file.name, frame: await about(file.name, () => readFrame(file)) };
  const times = dropped.frame.height / HEIGHT;
  byId("bin").value = Number.isInteger(times) && dropped.frame.width === times * WIDTH ? times : 1;
  byId("psf-name").textContent = file.name;
  byId("psf-name").parentElement.classList.add("full");
  byId("own").hidden = byId("format").hidden = false;
  again();
}

function useOwnCamera() {
  if (!dropped) return;
  dropped = null;
  byId("psf-name").textContent = `${camera.name} of this page; drop another one, or choose it`;
  byId("psf-name").parentElement.classList.remove("full");
  byId("own").hidden = byId("format").hidden = true;
}

function setUpFiles(id, take) {
  const input = byId(id);
  const accept = async (files) => {
    if (!files.length) return;
    say(`Reading ${files[0].name} …`);
    try {
      await take([...files]);
    } catch (error) {
      say(error instanceof FileError ? error.message : `The page failed: ${error.message}`, true);
    }
  };
  setUpDropZone(input, accept);
}

async function planes(name) {
  const stored = camera.images[name];
  if (!stored) return null;
  const bytes = await unpack(name);
  return { ...stored, data: new Float32Array(bytes.buffer, 0, bytes.length / 4) };
}

async function loadCamera() {
  own.psf = await planes("psf");
  own.format = { ...camera.format };
  for (const name of ["offset", "flat", "stray", "field"]) own.format[name] = await planes(name);
  for (const name of camera.samples) {
    const capture = { name, isSample: true, frame: await readFrame(new Blob([await unpack(`${name}.png`)])) };
    captures.push(capture);
    addButton(byId("samples"), capture);
  }
}

// The first sample, whose result in the package is known, tells whether this browser computes the same.
async function check(candidate) {
  await candidate.setPsf(own.psf, camera.channels);
  const measurement = toMeasurement(captures[0].frame, RAW);
  return agreement(await solve(candidate, measurement), camera.expected);
}

async function start() {
  if (typeof DecompressionStream === "undefined") throw new PageError("This browser is too old: Chromium 123, Firefox 120 or Safari 17.5 are needed.");
  await loadCamera();
  network = await openNetwork(check, say);
  prepared = own.psf;
  byId("checked").textContent = `${camera.method} on ${network.name}: agrees with mwdn ${camera.version} to ${network.agreement.toFixed(0)} dB on the first sample.`;
}

setUpDivider(byId("stack"), byId("split"), byId("zoom"));
setUpFiles("psf", takePsf);
setUpFiles("capture", takeCaptures);
byId("orientation").append(...ORIENTATIONS.map((name) => new Option(name, name)));
byId("camera-balance").hidden = !camera.white_balance;
byId("balance").value = camera.white_balance ? "camera" : "";
byId("psf-name").textContent = `${camera.name} of this page; drop another one, or choose it`;
const ownFrames = camera.about ? ` Captures of this camera: ${camera.about}.` : "";
byId("about").textContent = `Pictures of ${HEIGHT} x ${WIDTH} pixels (height x width).${ownFrames}`;
byId("controls").onsubmit = (event) => event.preventDefault();
for (const id of ["bin", "depth", "gamma", "psf-gamma", "orientation", "crop"]) byId(id).onchange = again;
byId("own").onclick = () => {
  useOwnCamera();
  again();
};
byId("exposure").oninput = () => {
  byId("exposure-value").textContent = Number(byId("exposure").value).toFixed(1);
  clearTimeout(due);
  due = setTimeout(() => enqueue(() => show()), 60);
};
byId("balance").onchange = () => enqueue(() => show());
byId("beside").onchange = () => byId("stack").classList.toggle("beside", byId("beside").checked);
byId("save-png").onclick = () => enqueue(() => save(".png", () => picture(8)));
byId("save-png16").onclick = () => enqueue(() => save("-16bit.png", () => picture(16)));
byId("save-npy").onclick = () => enqueue(() => save(".npy", async () => encodeNpy(balanced())));
// A file that misses its zone must not replace the page.
for (const name of ["dragover", "drop"]) document.addEventListener(name, (event) => event.preventDefault());
enqueue(start).then(() => network && !byId("chosen").dataset.current && choose(captures[0]));
