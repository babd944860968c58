// The page: what is chosen becomes a reconstruction, at once.
import { getBlob, getJson, post, remove, RequestError, runJob } from "./requests.js";
import { compareMethods, hideMethods } from "./comparison.js";
import { setUpDivider, setPicture } from "./divider.js";
import { setUpDropZone } from "./dropping.js";
import { calibration, cameraFields, chosen, liveSettings, look, ORIENTATIONS, orderFields, UPLOAD, whatIsMissing } from "./fields.js";
import { pageWords } from "./hints.js";
import { isLive, setUpLive, stopLive, wish } from "./live.js";
import { saveBlob } from "./saving.js";
import { drawSliders } from "./sliders.js";
import { showFindings, showVerdicts } from "./verdicts.js";

const byId = (id) => document.getElementById(id);

let methods = [];
let sampleCamera = null;
let running = null;
let latest = 0; // call of `showPictures`
let inspected = 0; // PSFs that have been chosen or inspected
const taken = {}; // number of files taken, by what they are
const due = new Map(); // timers by their work
let isTouched = false;

function say(text, wrong = false) {
  byId("state").textContent = pageWords(text);
  byId("state").classList.toggle("wrong", wrong);
}

async function guarded(work) {
  try {
    return await work();
  } catch (error) {
    if (error.name === "AbortError") return undefined;
    say(error instanceof RequestError ? error.message : `The page failed: ${error.message}`, true);
    return undefined;
  }
}

async function reconstruct() {
  if (isLive()) return void wish(liveSettings());
  running?.abort();
  if (whatIsMissing()) {
    hidePicture();
    say(whatIsMissing());
    return;
  }
  const mine = (running = new AbortController());
  let shown = false;
  byId("cancel").hidden = byId("progress").hidden = false;
  byId("progress").value = 0;
  try {
    const job = await runJob(orderFields(), async (now) => {
      byId("progress").value = now.progress;
      const words = { waiting: "Waiting for its turn …", reconstructing: "Reconstructing …", checking: "Checking the picture …" };
      if (words[now.state]) say(words[now.state]);
      if (now.report && !shown) {
        shown = true;
        chosen.job = now.id;
        showVerdicts(now.report); // none yet: those of the picture before are not of this one
        await showPictures(true);
      }
    }, mine.signal);
    if (mine.signal.aborted) return;
    const report = job.report;
    const lit = report.room_light ? ` ${Math.round(100 * report.room_light)} % of its light was the room’s.` : "";
    say(`${report.method}: ${report.width} × ${report.height} pixels in ${report.seconds.toFixed(2)} s.${lit}`);
    showVerdicts(report);
  } catch (error) {
    if (error.name === "AbortError" || mine.signal.aborted) return;
    if (!shown) hidePicture();
    say(error instanceof RequestError ? error.message : `The page failed: ${error.message}`, true);
  } finally {
    if (running === mine) {
      running = null;
      byId("cancel").hidden = byId("progress").hidden = true;
    }
  }
}

// That of other files, which must not stand for those that are chosen now.
function hidePicture() {
  chosen.job = null;
  for (const id of ["measurement", "scene"]) {
    URL.revokeObjectURL(byId(id).src);
    byId(id).removeAttribute("src");
  }
  byId("view").hidden = byId("trust-section").hidden = true;
}

// Sliders move faster than methods reconstruct: of each kind of work only the last call counts.
function soon(work = reconstruct, wait = 150) {
  isTouched = true;
  clearTimeout(due.get(work));
  due.set(work, setTimeout(() => guarded(work), wait));
}

async function showPictures(both = false) {
  if (isLive()) wish(liveSettings());
  if (isLive() || !chosen.job) return;
  const call = (latest += 1), job = chosen.job;
  const [scene, measurement] = await Promise.all([
    getBlob(`/jobs/${job}/picture${look()}`), both ? getBlob(`/jobs/${job}/measurement`) : null,
  ]);
  if (job !== chosen.job || (call !== latest && !both)) return; // a newer call shows a newer picture
  await setPicture(byId("scene"), scene);
  if (measurement) await setPicture(byId("measurement"), measurement);
  if (job !== chosen.job) return;
  byId("view").hidden = byId("psf-section").hidden = false;
}

const SAVED = { png: "reconstruction.png", png16: "reconstruction-16bit.png", tiff: "reconstruction.tif" };
const save = async (format) => saveBlob(await getBlob(`/jobs/${chosen.job}/picture${look(format)}`), SAVED[format]);

async function inspect() {
  const call = (inspected += 1);
  const findings = await post("/inspect", cameraFields());
  if (call === inspected) showFindings(findings);
}

// A snapshot of the live camera as a capture, to check it, compare methods and save the picture.
async function useSnapshot(frame, job) {
  stopLive();
  await take("capture", new File([frame], `frame-${job.report.number}.png`, { type: "image/png" }));
  await listCameras(job.camera);
  await reconstruct();
}

async function trySample(name, camera) {
  stopLive();
  say("Loading the sample …");
  const call = taken.capture;
  const data = await getBlob(`/samples/${name}`);
  if (call !== taken.capture || !(await take("capture", new File([data], `${name}.png`)))) return;
  chooseCamera(camera);
  await reconstruct();
}

// The file is read at once: a program that captures may write the next frame into it. Of files that are chosen while
// another one is read, the last counts; returns whether it is this one.
async function take(what, file) {
  const call = (taken[what] = (taken[what] ?? 0) + 1);
  const content = await file.arrayBuffer();
  if (call !== taken[what]) return false;
  chosen[what] = new File([content], file.name, { type: file.type });
  byId(`${what}-name`).textContent = file.name;
  byId(`${what}-name`).parentElement.classList.add("full");
  if (what === "psf") chooseCamera(UPLOAD);
  hideComparison();
  return true;
}

// Pictures of other methods, and the verdict on a PSF, of what was chosen before.
function hideComparison() {
  hideMethods();
  inspected += 1;
  byId("headline").textContent = "";
  byId("findings").replaceChildren();
}

function setUpDrop(what) {
  setUpDropZone(byId(what), async (files) => {
    if (files.length > 1) {
      running?.abort();
      say(`${files.length} files were dropped: drop one.`, true);
      return;
    }
    if (files[0] && !(await guarded(() => take(what, files[0])))) return;
    // The samples' camera is simulated: a visitor's capture is of another one.
    if (what === "capture" && byId("camera").value === sampleCamera) chooseCamera(UPLOAD);
    soon(reconstruct, 0);
  });
}

function chooseCamera(name) {
  if (name !== byId("camera").value) hideComparison();
  byId("camera").value = name;
  byId("format").disabled = byId("camera").value !== UPLOAD; // a stored calibration has its own
}

async function listCameras(selected) {
  const { cameras } = await getJson("/cameras");
  const words = { given: "of this server", stored: "stored", sample: "simulated" };
  byId("camera").replaceChildren(
    new Option("the PSF below", UPLOAD),
    ...cameras.map(({ name, kind, width, height }) => new Option(`${name} (${words[kind]}, ${width} × ${height})`, name)),
  );
  chooseCamera(selected ?? cameras[0].name);
}

async function storeCamera() {
  const name = byId("store-name").value.trim();
  if (!chosen.psf) throw new RequestError("Drop a PSF first.");
  await post("/cameras", { name, psf: chosen.psf, calibration: calibration() });
  await listCameras(name);
  say(`Stored as ${name}.`);
}

async function removeCamera() {
  const name = byId("camera").value;
  if (name === UPLOAD) throw new RequestError("Choose a stored calibration first.");
  await remove(`/cameras/${encodeURIComponent(name)}`);
  hideComparison();
  await listCameras();
  say(`${name} is removed.`);
}

// The settings of the live picture, which another page has changed.
function followLive({ method, options, align, room_light, stops, white_balance }) {
  byId("method").value = method;
  byId("align").checked = align === true;
  byId("room-light").value = room_light === null ? "" : String(room_light);
  byId("ambient-zone").hidden = true;
  showExposure(stops);
  byId("balance").value = white_balance;
  chooseMethod(options);
}

function showExposure(stops) {
  byId("exposure").value = stops;
  byId("exposure-value").textContent = Number(stops).toFixed(1);
}

function chooseMethod(values = {}) {
  const method = methods.find(({ name }) => name === byId("method").value);
  byId("about").textContent = method.about;
  drawSliders(byId("options"), method.options, () => soon(), values);
}

async function start() {
  const [listed, samples] = await Promise.all([getJson("/methods"), getJson("/samples"), listCameras()]);
  methods = listed.methods;
  sampleCamera = samples.camera;
  setUpLive(listed.live, {
    started: () => {
      running?.abort();
      if (isTouched) wish(liveSettings()); // else the settings of the server hold
    },
    follow: followLive,
    use: (frame, job) => guarded(() => useSnapshot(frame, job)),
  });
  byId("method").replaceChildren(...methods.map(({ name }) => new Option(name, name)));
  byId("method").value = "universal-small";
  chooseMethod();
  byId("orientation").append(...ORIENTATIONS.map((name) => new Option(name, name)));
  for (const name of samples.captures) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: name });
    button.onclick = () => guarded(() => trySample(name, samples.camera));
    byId("samples").append(button);
  }
}

setUpDivider(byId("stack"), byId("split"), byId("zoom"));
setUpDrop("psf");
setUpDrop("capture");
setUpDrop("ambient");
byId("controls").onsubmit = (event) => event.preventDefault();
byId("method").onchange = () => {
  chooseMethod();
  soon(reconstruct, 0);
};
byId("room-light").onchange = () => {
  byId("ambient-zone").hidden = byId("room-light").value !== "frame";
  hideMethods();
  soon(reconstruct, 0);
};
byId("camera").onchange = () => {
  chooseCamera(byId("camera").value);
  hideComparison();
  soon(reconstruct, 0);
};
for (const id of ["bin", "psf-bin", "bit-depth", "mosaic", "gamma", "psf-gamma", "orientation"]) {
  byId(id).onchange = () => {
    hideComparison();
    soon(reconstruct, 0);
  };
}
byId("align").onchange = () => {
  hideMethods();
  soon(reconstruct, 0);
};
byId("trust").onchange = () => soon(reconstruct, 0);
byId("exposure").oninput = () => {
  showExposure(byId("exposure").value);
  soon(showPictures);
};
byId("balance").onchange = () => soon(showPictures, 0);
byId("cancel").onclick = () => {
  running?.abort();
  say("Cancelled.");
};
byId("compare").onclick = () => guarded(() => compareMethods(methods));
byId("store").onclick = () => guarded(storeCamera);
byId("remove").onclick = () => guarded(removeCamera);
byId("inspect").onclick = () => guarded(inspect);
for (const format of Object.keys(SAVED)) byId(`save-${format}`).onclick = () => guarded(() => save(format));
// A file that misses its zone must not replace the page.
for (const name of ["dragover", "drop"]) document.addEventListener(name, (event) => event.preventDefault());
guarded(start);
