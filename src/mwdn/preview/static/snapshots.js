// Snapshots of the live camera: the raw frame and the picture of one moment.
import { getBlob, post, RequestError } from "./requests.js";
import { saveBlob } from "./saving.js";

const byId = (id) => document.getElementById(id);
const MAX_LISTED = 8; // of them are listed

function button(text, work) {
  const made = Object.assign(document.createElement("button"), { type: "button", textContent: text });
  made.onclick = async () => {
    try {
      await work();
    } catch (error) {
      byId("state").textContent = error.message;
      byId("state").classList.add("wrong");
    }
  };
  return made;
}

async function take(use) {
  const job = await post("/live/snapshots", {});
  const { number } = job.report;
  const address = URL.createObjectURL(await getBlob(`/jobs/${job.id}/picture`));
  const figure = document.createElement("figure");
  const picture = Object.assign(document.createElement("img"), { alt: `Reconstruction of frame ${number}`, src: address });
  const caption = Object.assign(document.createElement("figcaption"), { textContent: `Frame ${number}` });
  const row = Object.assign(document.createElement("div"), { className: "row" });
  const save = async (path, name) => saveBlob(await getBlob(`/jobs/${job.id}/${path}`), name);
  row.append(
    button("Picture", () => save("picture", `frame-${number}.png`)),
    button("Float TIFF", () => save("picture?format=tiff", `frame-${number}.tif`)),
    button("Raw frame", () => save("capture", `frame-${number}-raw.png`)),
    button("Work on it", async () => use(await getBlob(`/jobs/${job.id}/capture`), job)),
  );
  figure.append(picture, caption, row);
  byId("snapshots").prepend(figure);
  for (const old of [...byId("snapshots").children].slice(MAX_LISTED)) {
    URL.revokeObjectURL(old.querySelector("img").src);
    old.remove();
  }
  byId("snapshots-section").hidden = false;
}

export function setUpSnapshots(use) {
  byId("live-snapshot").onclick = async () => {
    try {
      await take(use);
    } catch (error) {
      byId("live-state").textContent = error instanceof RequestError ? error.message : `The page failed: ${error.message}`;
    }
  };
}
