// The live camera: one message a frame, with both pictures; a page that is slow gets fewer frames, not older ones.
import { setPicture } from "./divider.js";

const byId = (id) => document.getElementById(id);
const controls = ["live-record", "live-exposure", "live-gain"].map(byId);
let socket = null;
let isDrawing = false;
let isStarted = false;

function show(text, wrong = false) {
  byId("live-state").textContent = text;
  byId("live-state").classList.toggle("wrong", wrong);
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

async function draw(data) {
  const length = new DataView(data).getUint32(0, true);
  const said = JSON.parse(new TextDecoder().decode(data.slice(4, 4 + length)));
  if (said.error) {
    show(said.error, true);
    return;
  }
  const middle = 4 + length + said.measurement_bytes;
  const pictures = [data.slice(4 + length, middle), data.slice(middle)].map((part) => new Blob([part], { type: "image/jpeg" }));
  await Promise.all([setPicture(byId("measurement"), pictures[0]), setPicture(byId("scene"), pictures[1])]);
  byId("view").hidden = false;
  const recorded = said.recorded === null ? "" : `, ${said.recorded} frames recorded`;
  show(`${said.fps.toFixed(1)} frames a second, ${said.latency_ms} ms after the exposure, ${said.dropped} dropped${recorded}. ${said.refused}`, Boolean(said.refused));
  if (document.activeElement !== byId("live-exposure") && said.exposure_s !== null) byId("live-exposure").value = +(1000 * said.exposure_s).toPrecision(4);
  if (document.activeElement !== byId("live-gain") && said.gain !== null) byId("live-gain").value = said.gain;
}

function connect() {
  const address = new URL(`live${location.search}`, location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onmessage = async (event) => {
    if (isDrawing) return; // the next one is newer
    isDrawing = true;
    try {
      await draw(event.data);
    } catch (error) {
      show(`The page failed: ${error.message}`, true);
    } finally {
      isDrawing = false;
    }
  };
  socket.onclose = () => {
    socket = null;
    if (!isStarted) return;
    show("The connection is lost. Trying again …", true);
    setTimeout(() => isStarted && connect(), 1000);
  };
}

function toggle(button, is) {
  button.setAttribute("aria-pressed", String(is));
}

export function setUpLive(name) {
  if (!name) return;
  byId("live").hidden = false;
  show(`${name} is ready.`);
  byId("live-start").onclick = () => {
    isStarted = !isStarted;
    toggle(byId("live-start"), isStarted);
    byId("live-start").textContent = isStarted ? "Stop" : "Start";
    for (const control of controls) control.disabled = !isStarted;
    if (isStarted) {
      byId("trust-section").hidden = true; // its verdicts are of another capture
      byId("state").textContent = `Live: ${name}.`;
      connect();
    } else {
      toggle(byId("live-record"), false);
      socket?.close();
      show(`${name} is stopped.`);
    }
  };
  byId("live-record").onclick = () => {
    const is = byId("live-record").getAttribute("aria-pressed") !== "true";
    toggle(byId("live-record"), is);
    send({ record: is });
  };
  byId("live-exposure").onchange = () => send({ exposure_s: Number(byId("live-exposure").value) / 1000 });
  byId("live-gain").onchange = () => send({ gain: Number(byId("live-gain").value) });
}
