// Requests to the HTTP interface. If the server needs a token, the browser sends the cookie that stands for it.

export class RequestError extends Error {}

async function ask(path, options = {}) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new RequestError("The server does not answer. Is it running?");
  }
  if (!response.ok) {
    let said = "";
    try {
      said = (await response.json()).error;
    } catch {
      // Not from our server, or cut off: the status must do.
    }
    throw new RequestError(said || `The server answered with status ${response.status}.`);
  }
  return response;
}

export const getJson = async (path) => (await ask(path)).json();
export const getBlob = async (path) => (await ask(path)).blob();
export const remove = (path) => ask(path, { method: "DELETE" });

export async function post(path, fields) {
  const body = new FormData();
  for (const [name, value] of Object.entries(fields)) {
    if (value !== undefined && value !== null && value !== "") body.append(name, value);
  }
  return (await ask(path, { method: "POST", body })).json();
}

// Starts a job and follows it. `watch` is called with each state; when the picture is there, before it is checked.
export async function runJob(fields, watch, signal) {
  let job = await post("/jobs", fields);
  const id = job.id;
  let pause = 60;
  try {
    for (;;) {
      if (signal.aborted) throw new DOMException("replaced", "AbortError");
      await watch(job);
      if (["done", "failed", "cancelled"].includes(job.state)) break;
      await new Promise((resolve) => setTimeout(resolve, pause));
      pause = Math.min(pause * 1.3, 700);
      job = await getJson(`/jobs/${id}`);
    }
  } catch (error) {
    if (signal.aborted) remove(`/jobs/${id}`).catch(() => {});
    throw error;
  }
  if (job.state !== "done") throw new RequestError(job.error);
  return job;
}
