// The shell: routing, signing in and out, and the outage banner.
//
// A view is a module with `show(context)`, which may return `update(query)`, called when only the query of the URL
// has changed. `context.signal` aborts when the view is left: tie requests, streams and listeners to it.

import { call, isAbort, key, request, signals } from "./api.js";
import { fill, failure, h } from "./dom.js";
import { refreshTimes } from "./format.js";

const views = {
  jobs: () => import("./jobs.js"),
  job: () => import("./job.js"),
  maps: () => import("./maps.js"),
  map: () => import("./map.js"),
  try: () => import("./try.js"),
  health: () => import("./health.js"),
};

const main = document.getElementById("main");
let current = { name: "", leave: new AbortController(), update: null, failed: false };

/** Parses "#/maps/town?query=…" into a view, its argument and its query. */
function route() {
  const [path, query = ""] = location.hash.replace(/^#\/?/, "").split("?");
  const [head, ...rest] = path.split("/");
  let argument = rest.join("/");
  try { argument = decodeURIComponent(argument); } catch { /* shown as it is */ }
  let name = head || "jobs";
  if (argument && (name === "jobs" || name === "maps")) name = name.slice(0, -1);
  return { name, argument, query: new URLSearchParams(query), path };
}

/** Changes the query of the URL: in place, or as a history entry that the back button undoes. */
function setQuery(changes, { step = false } = {}) {
  const { path, query } = route();
  for (const [name, value] of Object.entries(changes)) {
    if (value) query.set(name, value);
    else query.delete(name);
  }
  const hash = `#/${path || "jobs"}${query.size ? `?${query}` : ""}`;
  if (hash === location.hash) return;
  if (step) location.hash = hash;
  else history.replaceState(null, "", hash);
}

async function render({ again = false } = {}) {
  const { name, argument, query } = route();
  if (!again && current.name === name && current.argument === argument && current.update) {
    current.update(query);
    return;
  }
  current.leave.abort();
  const leave = new AbortController();
  const moved = current.name !== "" && !again;
  current = { name, argument, leave, update: null, failed: false };
  const mine = current;
  mark(name);
  const root = h("div", { class: `view view-${views[name] ? name : "none"}` });
  const fail = (problem) => {
    if (isAbort(problem) || mine !== current || problem.status === 401) return;
    mine.failed = true;
    fill(root, failure(problem, () => render({ again: true })));
    if (!problem.title) console.error(problem);
  };
  const context = {
    root, argument, query, setQuery, fail,
    signal: leave.signal,
    title(text) { document.title = `${text} · whereabouts`; },
  };
  fill(main, root);
  if (!views[name]) {
    fill(root, h("h1", {}, "Page not found"), h("p", {}, h("a", { href: "#/jobs" }, "Go to the jobs")));
    return;
  }
  let view;
  try {
    view = await views[name]();
  } catch (error) {
    // The module did not load. Browsers may cache that failure until the page is reloaded.
    mine.reload = true;
    signals.dispatchEvent(new Event("unreachable"));
    fail({ title: "This page did not load", detail: "The server did not answer. This page keeps trying.", cause: error });
    return;
  }
  try {
    if (mine !== current) return;
    mine.update = (await view.show(context)) ?? null;
  } catch (problem) {
    fail(problem);
  }
  if (moved && mine === current) {
    scrollTo(0, 0);
    main.focus({ preventScroll: true });
  }
}

function mark(name) {
  const at = { job: "jobs", map: "maps" }[name] ?? name;
  for (const link of document.querySelectorAll(".top nav a")) {
    if (link.getAttribute("href") === `#/${at}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

// Signing in. The form replaces the view; the URL stays, so that signing in leads back to the view.

function signIn() {
  if (document.getElementById("sign-in")) return;
  const refused = key.get() !== null;
  current.leave.abort();
  current.update = null;
  const input = h("input", { type: "password", id: "key", name: "key", autocomplete: "off", required: true, spellcheck: "false" });
  const said = h("p", { class: "form-error", role: "alert" });
  const form = h("form", { id: "sign-in", class: "card narrow" },
    h("h1", {}, "Sign in"),
    h("p", {}, "This server requires an API key. It is kept until you close this tab or sign out."),
    h("label", { for: "key" }, "API key"), input, said,
    h("div", { class: "actions" }, h("button", { class: "primary", type: "submit" }, "Sign in")),
    h("h2", {}, "No key yet?"),
    h("p", {}, "Anyone with the role admin can create one; the role operator is enough for most of this console:"),
    h("pre", { class: "command", tabindex: "0" }, h("code", {}, "whereabouts keys create --role operator --name 'my name'")),
    h("p", { class: "muted" }, "The first key is created in the data folder while the server is stopped: add ",
      h("code", {}, "--data DIR --role admin"), "."));
  if (refused) said.textContent = "The key is invalid, expired or revoked.";
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    key.set(input.value.trim());
    try {
      await call("maps");
    } catch (problem) {
      if (problem.status === 401) {
        key.set(null);
        said.textContent = "The server does not know this key, or it has expired. Check that you copied all of it.";
        input.select();
        return;
      }
      if (problem.status !== 403) { said.textContent = problem.detail; return; }
    }
    showSignOut();
    render({ again: true });
  });
  document.title = "Sign in · whereabouts";
  fill(main, form);
  input.focus();
}

const signOut = document.getElementById("sign-out");
function showSignOut() { signOut.hidden = key.get() === null; }
signOut.addEventListener("click", () => {
  key.set(null);
  showSignOut();
  render({ again: true });
});
signals.addEventListener("unauthorized", signIn);

// While the server is down, probe it with backoff; then reload what failed in the meantime.

const outage = document.getElementById("outage");
let probing = false;
async function probe() {
  if (probing) return;
  probing = true;
  outage.hidden = false;
  outage.textContent = "The server does not answer. Trying again…";
  for (let wait = 1000; !outage.hidden; wait = Math.min(wait * 1.6, 15000)) {
    await new Promise((done) => setTimeout(done, wait));
    if (!outage.hidden) await request("livez").catch(() => {});
  }
  probing = false;
}
signals.addEventListener("unreachable", probe);
signals.addEventListener("reachable", () => {
  if (outage.hidden) return;
  outage.hidden = true;
  if (current.reload) location.reload();
  else if (current.failed) render({ again: true });
});

// Light and dark follow the system unless the user chose one.

const theme = document.getElementById("theme");
const themes = ["auto", "light", "dark"];
function setTheme(name) {
  if (name === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  theme.textContent = `Theme: ${name}`;
  dispatchEvent(new Event("themechange"));
}
const stored = () => { try { return localStorage.getItem("whereabouts-theme"); } catch { return null; } };
theme.addEventListener("click", () => {
  const next = themes[(themes.indexOf(document.documentElement.dataset.theme ?? "auto") + 1) % themes.length];
  setTheme(next);
  try { localStorage.setItem("whereabouts-theme", next); } catch { /* then it lasts for this page only */ }
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => dispatchEvent(new Event("themechange")));
setTheme(themes.includes(stored()) ? stored() : "auto");

setInterval(() => refreshTimes(main), 5000);
addEventListener("hashchange", () => render());
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // "#main" is not a view
  main.focus();
});
showSignOut();
render();
