// The network in onnxruntime-web: on the graphics card where WebGPU works, else in WebAssembly. Nothing is fetched but this
// folder's scripts, which hold everything as text, so that the page works from a disk, where a browser refuses other files.
import { inflate } from "./png.js";

export class PageError extends Error {}

const NAMES = { webgpu: "WebGPU", wasm: "WebAssembly" };
const LIBRARIES = { webgpu: "ort.webgpu.min.js", wasm: "ort.wasm.min.js" };
const MIN_AGREEMENT = 50;
globalThis.mwdnFiles ??= {};

function loadScript(name) {
  return new Promise((done, fail) => {
    const script = Object.assign(document.createElement("script"), { src: name });
    script.onload = done;
    script.onerror = () => fail(new PageError(`${name} is missing. Copy the whole folder.`));
    document.head.append(script);
  });
}

// A file that a script has stored as base64 of gzip.
export async function unpack(name) {
  const { text, length } = globalThis.mwdnFiles[name] ?? {};
  if (!text) throw new PageError(`${name} is missing. Copy the whole folder.`);
  const packed = await (await fetch(`data:application/octet-stream;base64,${text}`)).arrayBuffer();
  const bytes = await inflate(packed, length, "gzip");
  if (bytes.length !== length) throw new PageError(`${name} is damaged. Copy the folder again.`);
  return bytes;
}

async function startRuntime(kind) {
  await loadScript(LIBRARIES[kind]);
  await loadScript(`runtime-${kind}.js`);
  const { ort } = globalThis;
  const loader = new Blob([await unpack(`${kind}.mjs`)], { type: "text/javascript" });
  ort.env.wasm.wasmBinary = (await unpack(`${kind}.wasm`)).buffer;
  ort.env.wasm.wasmPaths = { mjs: URL.createObjectURL(loader) };
  ort.env.wasm.numThreads = 1; // more need headers that static hosts do not send
  ort.env.logLevel = "error";
  delete globalThis.mwdnFiles[`${kind}.wasm`];
  return ort;
}

class Network {
  constructor(ort, kind, prepare, reconstruct) {
    Object.assign(this, { ort, kind, prepare, sessions: [prepare, reconstruct], name: NAMES[kind], prepared: null });
  }

  tensor({ channels, height, width, data }, wanted) {
    if (channels === wanted) return new this.ort.Tensor("float32", data, [1, channels, height, width]);
    const repeated = new Float32Array(wanted * data.length); // grey as equal colours
    for (let channel = 0; channel < wanted; channel += 1) repeated.set(data, channel * data.length);
    return new this.ort.Tensor("float32", repeated, [1, wanted, height, width]);
  }

  // What depends on the PSF alone: its transfer functions, among others.
  async setPsf(psf, channels) {
    this.prepared = await this.sessions[0].run({ psf: this.tensor(psf, channels) });
  }

  async reconstruct(measurement, channels) {
    const { scene } = await this.sessions[1].run({ measurement: this.tensor(measurement, channels), ...this.prepared });
    const image = { ...measurement, channels, data: new Float32Array(scene.data) };
    if (!image.data.every(Number.isFinite)) throw new PageError("The network's result is not finite.");
    return image;
  }
}

async function open(kind, models, say) {
  say(`Loading onnxruntime-web for ${NAMES[kind]} …`);
  const ort = await startRuntime(kind);
  say(`Starting the network on ${NAMES[kind]} …`);
  const options = { executionProviders: [kind], graphOptimizationLevel: "all" };
  const sessions = [];
  for (const model of models) sessions.push(await ort.InferenceSession.create(model, options));
  return new Network(ort, kind, ...sessions);
}

// PSNR in dB at some pixels whose values the package has computed.
export function agreement(scene, { step, values }) {
  const error = values.reduce((sum, value, index) => sum + (value - scene.data[index * step]) ** 2, 0) / values.length;
  return 10 * Math.log10(Math.max(...values) ** 2 / error);
}

// A graphics card; a browser without one may offer to imitate it, a hundred times as slow as WebAssembly.
async function hasWebGpu() {
  try {
    const adapter = await navigator.gpu?.requestAdapter();
    return Boolean(adapter) && !(adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter);
  } catch {
    return false;
  }
}

// The network on the best processor that gives the package's result for a capture that it knows.
export async function openNetwork(check, say) {
  say("Loading the network …");
  await loadScript("network.js");
  const models = [await unpack("prepare.onnx"), await unpack("reconstruct.onnx")];
  const asked = new URLSearchParams(location.search).get("backend");
  const kinds = asked in NAMES ? [asked] : [...((await hasWebGpu()) ? ["webgpu"] : []), "wasm"];
  for (const kind of kinds) {
    try {
      const network = await open(kind, models, say);
      say(`Checking the network on ${NAMES[kind]} …`);
      network.agreement = await check(network);
      if (!(network.agreement >= MIN_AGREEMENT)) throw new PageError(`${NAMES[kind]} computes another picture than mwdn (${network.agreement.toFixed(0)} dB).`);
      return network;
    } catch (error) {
      if (kind === kinds.at(-1)) throw error;
      console.warn(`${NAMES[kind]} is not used: ${error.message}`);
    }
  }
  return undefined;
}
