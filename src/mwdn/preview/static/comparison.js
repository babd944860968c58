// The capture by all methods, as small pictures.
import { setPicture } from "./divider.js";
import { look, orderFields, whatIsMissing } from "./fields.js";
import { getBlob, runJob } from "./requests.js";

const byId = (id) => document.getElementById(id);
let comparing = null;

export async function compareMethods(methods) {
  if (whatIsMissing()) return;
  comparing?.abort();
  const { signal } = (comparing = new AbortController());
  byId("grid-section").hidden = false;
  byId("grid").replaceChildren();
  for (const [name, order] of methods.map(({ name }) => [name, orderFields(name, false)])) {
    const figure = document.createElement("figure");
    const picture = Object.assign(document.createElement("img"), { alt: `Reconstruction by ${name}` });
    const caption = Object.assign(document.createElement("figcaption"), { textContent: `${name} …` });
    figure.append(picture, caption);
    byId("grid").append(figure);
    try {
      const job = await runJob(order, () => {}, signal);
      await setPicture(picture, await getBlob(`/jobs/${job.id}/picture${look()}`));
      caption.textContent = `${name}, ${job.report.seconds.toFixed(2)} s`;
    } catch (error) {
      if (signal.aborted) return;
      caption.textContent = `${name}: ${error.message}`;
      caption.className = "wrong";
    }
  }
}

export function hideMethods() {
  comparing?.abort();
  byId("grid-section").hidden = true;
}
