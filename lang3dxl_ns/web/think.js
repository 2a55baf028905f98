// The page's worker: jobs that think about the scene beside its drawing.

/** Ask the page's server, as `fetch` does. */
export async function request(...asked) {
  try {
    return await fetch(...asked);
  } catch {
    throw new Error("The server of this page doesn't answer: start it again, or check the connection.");
  }
}

/** Fetch a file of the page; a written page's data have names by content. */
export async function fetched(name, about = null) {
  const file = await request(about?.files?.[name] ?? name);
  if (!file.ok) throw new Error(`${name} is missing (${file.status}): write the page again.`);
  return file;
}

/** Start a worker; returns a function that gives it a job and resolves to the answer. told: called with the share of
 * the scene that has been read; failed: called if the worker can't run. */
export function thinker(told, failed) {
  const worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" }), waiting = new Map();
  worker.onmessage = ({ data: { id, output, error, done } }) => {
    if (done !== undefined) return told(done);
    const [resolve, reject] = waiting.get(id);
    waiting.delete(id);
    if (error) reject(new Error(error));
    else resolve(output);
  };
  worker.onerror = failed;
  return (job, input = {}) =>
    new Promise((...settle) => {
      const id = Math.random();
      waiting.set(id, settle);
      worker.postMessage({ id, job, input });
    });
}
