// The live camera: one message a frame, with both pictures; a page that is slow gets fewer frames, not older ones.
import { clockOffset, compareClocks, tellClock } from "./clock.js";
import { pageWords } from "./hints.js";
import { setUpSnapshots } from "./snapshots.js";

const byId = (id) => document.getElementById(id);
const controls = ["live-record", "live-snapshot", "live-exposure", "live-gain"].map(byId);
const wishes = {}; // of this page, for a server that was started again
const PATIENCE_MS = 3000; // until the server has followed a wish; then its settings are shown again
const SHARED = ["method", "options", "align", "room_light", "stops", "white_balance"]; // by all pages
const READABLE_MS = 250; // between changes of the numbers: those of each frame cannot be read, and cost a layout
let toldAt = -Infinity;
let refused = "";
let wishedAt = -Infinity;
let followed = ""; // the shared settings that the controls of this page show
let page = null;
const shown = { count: 0, latency_ms: 0 };
let socket = null;
let isStarted = false;
let isDrawing = false;
let next = null;
let retry = 0; // timer of the next attempt to connect

function show(text, wrong = false) {
  byId("live-state").textContent = pageWords(text);
  byId("live-state").classList.toggle("wrong", wrong);
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

const shared = (settings) => Object.fromEntries(SHARED.map((name) => [name, settings[name]]));

// A setting: kept, and sent again when the connection comes back.
export function wish(message) {
  Object.assign(wishes, message);
  if ("method" in message) followed = JSON.stringify(shared(message));
  wishedAt = performance.now();
  send(message);
}

export const isLive = () => isStarted;

function parse(data) {
  const length = new DataView(data).getUint32(0, true);
  const said = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const parts = [new Uint8Array(data, 4 + length, said.measurement_bytes ?? 0), new Uint8Array(data, 4 + length + (said.measurement_bytes ?? 0))];
  return [said, parts];
}

const decode = (part) => createImageBitmap(new Blob([part], { type: "image/jpeg" }));
const nextPaint = () => new Promise((resolve) => { requestAnimationFrame(resolve); });

function paint(canvas, picture) {
  if (canvas.width !== picture.width || canvas.height !== picture.height) Object.assign(canvas, { width: picture.width, height: picture.height });
  canvas.getContext("bitmaprenderer").transferFromImageBitmap(picture);
}

function tell(said) {
  const offset = clockOffset();
  shown.count += 1;
  shown.latency_ms = offset === null ? said.latency_ms : Date.now() + offset - 1000 * said.timestamp;
  Object.assign(byId("live-state").dataset, { frame: said.number, count: shown.count, latency: shown.latency_ms.toFixed(1) });
  if (performance.now() - toldAt < READABLE_MS && said.refused === refused) return;
  toldAt = performance.now();
  refused = said.refused;
  tellInWords(said);
}

function tellInWords(said) {
  const recorded = said.recorded === null ? "" : `, ${said.recorded} frames recorded in ${said.recording}`;
  byId("live-badge").textContent = `${said.fps.toFixed(1)} fps · ${Math.round(shown.latency_ms)} ms`;
  show(`${said.fps.toFixed(1)} frames a second, ${Math.round(shown.latency_ms)} ms after the exposure, ${said.dropped} dropped${recorded}. ${said.refused}`, Boolean(said.refused));
  byId("live-record").setAttribute("aria-pressed", String(said.recorded !== null));
  byId("live-ambient").setAttribute("aria-pressed", String(said.ambient));
  if (document.activeElement !== byId("live-exposure") && said.exposure_s !== null) byId("live-exposure").value = +(1000 * said.exposure_s).toPrecision(4);
  if (document.activeElement !== byId("live-gain") && said.gain !== null) byId("live-gain").value = said.gain;
}

// Settings are shared: another page may have changed them.
function showSettings(said) {
  const settings = shared(said);
  const now = JSON.stringify(settings);
  if (now === followed) wishedAt = -Infinity;
  if (now === followed || performance.now() - wishedAt < PATIENCE_MS) return;
  followed = now;
  if ("method" in wishes) Object.assign(wishes, settings);
  page.follow(settings);
}

async function draw(data) {
  const [said, parts] = parse(data);
  if (said.error) {
    show(`${said.error} Trying again …`, true);
    return;
  }
  const pictures = await Promise.all(parts.map(decode));
  await nextPaint();
  if (!isStarted) return;
  paint(byId("live-measurement"), pictures[0]);
  paint(byId("live-scene"), pictures[1]);
  byId("view").hidden = false;
  byId("stack").classList.add("live");
  tell(said);
  showSettings(said);
}

// One frame at a time; of those that come meanwhile, the newest.
async function drawNewest() {
  if (isDrawing) return;
  isDrawing = true;
  while (next) {
    const data = next;
    next = null;
    try {
      await draw(data);
    } catch (error) {
      show(`The page failed: ${error.message}`, true);
    }
    send({ shown: true });
  }
  isDrawing = false;
}

function connect() {
  const address = new URL("live", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const own = (socket = new WebSocket(address));
  own.binaryType = "arraybuffer";
  own.onopen = () => {
    if (socket !== own) return;
    compareClocks(send);
    if (Object.keys(wishes).length) send(wishes);
  };
  own.onmessage = (event) => {
    if (socket !== own) return;
    if (typeof event.data === "string") {
      tellClock(JSON.parse(event.data), send);
      return;
    }
    if (next) send({ shown: true }); // replaced: it will never be
    next = event.data;
    drawNewest();
  };
  own.onclose = () => {
    if (socket !== own) return; // stopped
    socket = null;
    show("The connection is lost. Trying again …", true);
    retry = setTimeout(connect, 1000);
  };
}

function start(name) {
  byId("trust-section").hidden = true; // its verdicts are of another capture
  byId("state").textContent = `Live: ${name}.`;
  page.started();
  connect();
}

function stop(name) {
  byId("live-record").setAttribute("aria-pressed", "false");
  clearTimeout(retry);
  const old = socket;
  socket = next = null;
  old?.close();
  byId("stack").classList.remove("live");
  byId("view").hidden = !byId("scene").src;
  byId("state").textContent = "";
  show(`${name} is stopped.`);
}

export function stopLive() {
  if (isStarted) byId("live-start").click();
}

// `parts` of the page: `started()`, `follow(settings)` of another page, `use(frame, job)` of a snapshot.
export function setUpLive(name, parts) {
  if (!name) return;
  page = parts;
  byId("live").hidden = false;
  show(`${name} is ready.`);
  byId("live-start").onclick = () => {
    isStarted = !isStarted;
    byId("live-start").setAttribute("aria-pressed", String(isStarted));
    byId("live-start").textContent = isStarted ? "Stop" : "Start";
    for (const control of [...controls, byId("live-ambient")]) control.disabled = !isStarted;
    document.body.classList.toggle("live", isStarted);
    if (isStarted) start(name);
    else stop(name);
  };
  const toggle = (id, name) => {
    byId(id).onclick = () => send({ [name]: byId(id).getAttribute("aria-pressed") !== "true" });
  };
  toggle("live-record", "record");
  toggle("live-ambient", "ambient");
  const whenGiven = (id, wanted) => { // an empty field, or one that holds no number, is no wish
    byId(id).onchange = () => byId(id).value && byId(id).reportValidity() && wish(wanted(Number(byId(id).value)));
  };
  whenGiven("live-exposure", (milliseconds) => ({ exposure_s: milliseconds / 1000 }));
  whenGiven("live-gain", (gain) => ({ gain }));
  setUpSnapshots(page.use);
}
