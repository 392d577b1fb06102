// The API client: authentication, uniform errors, authenticated pictures, and server-sent events over fetch.

const KEY = "whereabouts-key";
let memory = null; // Fallback if the browser forbids storage; lost when the page is left.

export const key = {
  get() { try { return sessionStorage.getItem(KEY) ?? memory; } catch { return memory; } },
  set(value) {
    memory = value;
    try { if (value) sessionStorage.setItem(KEY, value); else sessionStorage.removeItem(KEY); } catch { /* memory has it */ }
  },
};

/** Events for the shell: `unauthorized`, `unreachable`, `reachable`. */
export const signals = new EventTarget();
const tell = (name) => signals.dispatchEvent(new Event(name));

/** An RFC 9457 problem, or the absence of a response (`status` 0). */
export class Problem extends Error {
  constructor({ status, title, detail, type, request_id: requestId }) {
    super(detail ?? title);
    Object.assign(this, { status, title, detail, type, requestId });
  }
}

async function problemOf(answer) {
  let told = {};
  try { told = await answer.json(); } catch { /* a proxy may send something other than JSON */ }
  const problem = { title: `The server answered ${answer.status}`, detail: answer.statusText, ...told, status: answer.status };
  if (answer.status === 403) problem.title = "This key has no permission for that";
  const wait = answer.headers.get("retry-after");
  if (answer.status === 429 && wait) problem.detail = `${problem.detail} Try again in ${wait} s.`;
  return new Problem(problem);
}

/** An authenticated request. Throws `Problem`, or `AbortError` if `signal` aborts. */
export async function request(path, { method = "GET", body, headers = {}, signal } = {}) {
  const held = key.get();
  if (held) headers = { ...headers, Authorization: `Bearer ${held}` };
  let answer;
  try {
    // Relative, so that the console works behind a proxy that serves it under a subpath.
    answer = await fetch(path.replace(/^\//, ""), { method, body, headers, signal });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    tell("unreachable");
    throw new Problem({ status: 0, title: "The server does not answer", detail: "This page keeps trying. Is whereabouts running, and is the network up?" });
  }
  tell("reachable");
  if (answer.status === 401) tell("unauthorized");
  if (!answer.ok) throw await problemOf(answer);
  return answer;
}

/** A request with a JSON response; `json`, if given, is posted as the body. */
export async function call(path, { json, ...options } = {}) {
  if (json !== undefined) {
    options = { method: "POST", ...options, body: JSON.stringify(json), headers: { "Content-Type": "application/json" } };
  }
  const answer = await request(path, options);
  return answer.status === 204 ? null : answer.json();
}

export const isAbort = (error) => error?.name === "AbortError";

/** A relative URL of path segments and a query; empty query values are skipped. */
export function address(parts, query = {}) {
  // Browsers resolve `..` in a path in any encoding, so a request for an image of that name would go elsewhere.
  if (parts.some((part) => part === "." || part === "..")) {
    throw new Problem({ status: 400, title: "A browser cannot request this name", detail: "The name is one or two dots. Use another client, such as curl --path-as-is." });
  }
  const path = parts.map(encodeURIComponent).join("/");
  const given = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== null && value !== undefined && value !== ""));
  return given.size ? `${path}?${given}` : path;
}

export const contentOf = (map, image, maxEdge) => address(["maps", map, "images", image, "content"], { max_edge: maxEdge });
export const frameOf = (job, maxEdge) => address(["jobs", job, "frame"], { max_edge: maxEdge });

const waiting = new Map();
const nearby = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    nearby.unobserve(target);
    waiting.get(target)?.();
    waiting.delete(target);
  }
}, { rootMargin: "200px" });

/**
 * An authenticated picture: fetched when it scrolls near the viewport, shown from memory, and released once it is
 * drawn. `gone` is the text to show if it does not exist.
 */
export function picture(path, alt, { signal, gone = "No picture.", className = "", loaded } = {}) {
  const image = document.createElement("img");
  image.alt = alt;
  const box = document.createElement("div");
  box.className = `picture ${className}`;
  box.append(image);
  const refuse = (text) => {
    box.classList.add("gone");
    box.replaceChildren(Object.assign(document.createElement("span"), { textContent: text }));
  };
  waiting.set(box, async () => {
    let source;
    try {
      source = URL.createObjectURL(await (await request(path, { signal })).blob());
    } catch (error) {
      if (!isAbort(error)) refuse(error.status === 404 ? gone : `No picture: ${error.title}.`);
      return;
    }
    image.addEventListener("load", () => { URL.revokeObjectURL(source); box.classList.add("here"); loaded?.(image); });
    image.addEventListener("error", () => { URL.revokeObjectURL(source); refuse("The browser cannot show this picture."); });
    image.src = source;
  });
  signal?.addEventListener("abort", () => { nearby.unobserve(box); waiting.delete(box); });
  nearby.observe(box);
  return box;
}

const pause = (ms, signal) => new Promise((done) => {
  const timer = setTimeout(done, ms);
  signal.addEventListener("abort", () => { clearTimeout(timer); done(); }, { once: true });
});

const shown = () => new Promise((done) => {
  if (!document.hidden) return done();
  document.addEventListener("visibilitychange", done, { once: true });
});

/**
 * Follows server-sent events until `signal` aborts or `on` returns true. Reconnects with exponential backoff up to
 * 15 s. A hidden tab holds no stream, because browsers allow only six HTTP/1.1 connections per server.
 *
 *     on(event, data)   an event with its parsed data
 *     status(state)     "live" | "waiting"
 *     failed(problem)   the server rejects the stream; no reconnect
 */
export async function follow(path, { signal, on, status = () => {}, failed = () => {} }) {
  let tries = 0;
  while (!signal.aborted) {
    await shown();
    const leave = new AbortController();
    const hide = () => { if (document.hidden) leave.abort(); };
    const stop = () => leave.abort();
    document.addEventListener("visibilitychange", hide);
    signal.addEventListener("abort", stop);
    try {
      const answer = await request(path, { signal: leave.signal, headers: { Accept: "text/event-stream" } });
      status("live");
      tries = 0;
      if (await readEvents(answer.body, on)) return;
    } catch (error) {
      if (error instanceof Problem && [400, 401, 403, 404].includes(error.status)) {
        failed(error);
        return;
      }
    } finally {
      document.removeEventListener("visibilitychange", hide);
      signal.removeEventListener("abort", stop);
    }
    if (signal.aborted) return;
    status("waiting");
    if (!leave.signal.aborted) await pause(Math.min(15000, 500 * 2 ** tries) * (0.75 + Math.random() / 2), signal);
    tries += 1;
  }
}

async function readEvents(body, on) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return false;
    const events = (rest + value).split(/\r?\n\r?\n/);
    rest = events.pop();
    for (const event of events) {
      let name = "message";
      const data = [];
      for (const line of event.split(/\r?\n/)) {
        if (line.startsWith("event:")) name = line.slice(6).trim();
        else if (line.startsWith("data:")) data.push(line.slice(5).trimStart());
      }
      if (data.length && on(name, JSON.parse(data.join("\n")))) {
        reader.cancel();
        return true;
      }
    }
  }
}
