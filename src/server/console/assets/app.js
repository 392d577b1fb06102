// The shell: which view the address names, signing in and out, and what is said while the server is away.
//
// A view is a module with `show(context)`, which may return `update(query)`, called when only the query of its
// address has changed. `context.signal` aborts when the view is left: requests, streams and listeners hang on it.

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

/** "#/maps/town?query=…" as a view, its argument and its query. */
function route() {
  const [path, query = ""] = location.hash.replace(/^#\/?/, "").split("?");
  const [head, ...rest] = path.split("/");
  let argument = rest.join("/");
  try { argument = decodeURIComponent(argument); } catch { /* shown as it is */ }
  let name = head || "jobs";
  if (argument && (name === "jobs" || name === "maps")) name = name.slice(0, -1);
  return { name, argument, query: new URLSearchParams(query), path };
}

/** Changes the query of the address: in place, or as a step that the back button undoes. */
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
    fill(root, h("h1", {}, "There is no such page"), h("p", {}, h("a", { href: "#/jobs" }, "To the jobs")));
    return;
  }
  let view;
  try {
    view = await views[name]();
  } catch (error) {
    // The file did not come. Browsers may remember that of a module until the page is loaded again.
    mine.reload = true;
    signals.dispatchEvent(new Event("unreachable"));
    fail({ title: "This page did not load", detail: "The server did not answer. This page goes on trying.", cause: error });
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

// Signing in. The form takes the place of the view; the address stays, so that signing in leads there.

function signIn() {
  if (document.getElementById("sign-in")) return;
  const refused = key.get() !== null;
  current.leave.abort();
  current.update = null;
  const input = h("input", { type: "password", id: "key", name: "key", autocomplete: "off", required: true, spellcheck: "false" });
  const said = h("p", { class: "form-error", role: "alert" });
  const form = h("form", { id: "sign-in", class: "card narrow" },
    h("h1", {}, "Sign in"),
    h("p", {}, "This server asks for an API key. It is kept until you close this tab or sign out."),
    h("label", { for: "key" }, "API key"), input, said,
    h("div", { class: "actions" }, h("button", { class: "primary", type: "submit" }, "Sign in")),
    h("h2", {}, "No key yet?"),
    h("p", {}, "Whoever has the role admin makes one; the role operator is enough for most of this page:"),
    h("pre", { class: "command", tabindex: "0" }, h("code", {}, "whereabouts keys create --role operator --name 'my name'")),
    h("p", { class: "muted" }, "The very first key is made in the data folder, while the server does not run: add ",
      h("code", {}, "--data DIR --role admin"), "."));
  if (refused) said.textContent = "The key is not valid, or not any more.";
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    key.set(input.value.trim());
    try {
      await call("maps");
    } catch (problem) {
      if (problem.status === 401) {
        key.set(null);
        said.textContent = "The server does not know this key, or it has ended. Check that all of it was copied.";
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

// While the server is away, ask it ever less often; what failed meanwhile is loaded again.

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

// Light and dark follow the system unless somebody chose.

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
  try { localStorage.setItem("whereabouts-theme", next); } catch { /* for this page only, then */ }
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => dispatchEvent(new Event("themechange")));
setTheme(themes.includes(stored()) ? stored() : "auto");

setInterval(() => refreshTimes(main), 5000);
addEventListener("hashchange", () => render());
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // "#main" is no view
  main.focus();
});
showSignOut();
render();
