// The display of a capture session: draws each picture pixel by pixel, and says when it is on the screen.
"use strict";

const canvas = document.getElementById("screen");
const panel = { state: document.getElementById("state"), size: document.getElementById("size") };
// Read back after each drawing: kept in memory, not on the graphics card.
const context = canvas.getContext("2d", { alpha: false, colorSpace: "srgb", willReadFrequently: true });
let socket = null;
let setup = null;
let latest = 0;
// The session starts once the page has its final size: full-screen, or by the second button. "#start" is for kiosks.
let started = location.hash === "#start" || window.matchMedia("(display-mode: fullscreen)").matches;

function measure(entry) {
  const ratio = window.devicePixelRatio;
  const box = entry?.devicePixelContentBoxSize?.[0];
  const width = box ? box.inlineSize : Math.round(canvas.clientWidth * ratio);
  const height = box ? box.blockSize : Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  panel.size.textContent = `${width} × ${height} pixels`;
  if (setup) {
    document.getElementById("ruler").style.width = `${(10 / setup.width_cm) * window.screen.width}px`;
  }
  send({});
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) {
    const visible = document.visibilityState === "visible";
    socket.send(JSON.stringify({ width: canvas.width, height: canvas.height, visible, ready: started, ...message }));
  }
}

// Sum of (2 i + 1) times pixel i, modulo 2^32.
function checksum() {
  const bytes = context.getImageData(0, 0, canvas.width, canvas.height).data;
  const pixels = new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
  let sum = 0;
  for (let i = 0; i < pixels.length; i++) {
    sum = (sum + Math.imul(pixels[i], 2 * i + 1)) | 0;
  }
  return sum >>> 0;
}

async function show(data) {
  const id = new DataView(data).getUint32(0, true);
  latest = id;
  document.body.classList.add("showing");
  try {
    const options = { colorSpaceConversion: "none", premultiplyAlpha: "none" };
    const picture = await createImageBitmap(new Blob([data.slice(4)], { type: "image/png" }), options);
    if (id !== latest) return;
    context.imageSmoothingEnabled = false;
    context.fillStyle = "#000";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(picture, 0, 0);
    picture.close();
    const sum = checksum();
    // The first callback runs before the frame with this drawing is composed, the second after it.
    requestAnimationFrame(() => requestAnimationFrame(() => send({ id, sum })));
  } catch (error) {
    send({ id, error: String(error).slice(0, 200) });
  }
}

function connect() {
  const address = new URL("display" + location.search, location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    panel.state.textContent = "Connected. The session starts when you press a button.";
    measure();
  };
  socket.onmessage = (event) => {
    if (typeof event.data === "string") {
      setup = JSON.parse(event.data);
      measure();
    } else {
      show(event.data);
    }
  };
  socket.onclose = (event) => {
    if (event.code === 4000) {
      document.body.classList.remove("showing");
      panel.state.textContent = "Another page has become the display. Reload this one to use it instead.";
      return;
    }
    if (event.code === 1001) {
      document.body.classList.remove("showing");
      context.fillRect(0, 0, canvas.width, canvas.height);
    }
    panel.state.textContent = "Not connected. Waiting for the session …";
    setTimeout(connect, 1000);
  };
}

async function stayAwake() {
  try {
    await navigator.wakeLock?.request("screen");
  } catch {
    // Refused while the page is hidden, or on another computer without https: switch power saving off by hand.
  }
}

function start() {
  started = true;
  panel.state.textContent = "The session starts.";
  measure();
}

document.getElementById("full").onclick = () => document.documentElement.requestFullscreen();
document.getElementById("window").onclick = start;
// The window takes its final size some frames after the event.
document.addEventListener("fullscreenchange", () => document.fullscreenElement && setTimeout(start, 1000));
document.addEventListener("visibilitychange", () => {
  send({});
  if (document.visibilityState === "visible") stayAwake();
});
new ResizeObserver((entries) => measure(entries[0])).observe(canvas);
stayAwake();
connect();
