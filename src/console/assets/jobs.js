// The list of jobs, live: one stream for all of them, the first page again when something has ended, and no
// request per row.

import { address, call, follow, isAbort } from "./api.js";
import { announce, badge, command, empty, failure, fill, h, loading } from "./dom.js";
import { cost, count, duration, percent, plural, shortId, timeAgo } from "./format.js";

const PAGE = 50;
const STATES = ["queued", "running", "succeeded", "degraded", "failed", "cancelled"];
const ENDED = new Set(["succeeded", "degraded", "failed", "cancelled"]);

// Older servers know no `brief`: their lists come with all descriptions, which is slow but right.
let brief = true;

async function page(query, signal) {
  try {
    return await call(address(["jobs"], { ...query, brief: brief ? "true" : null }), { signal });
  } catch (problem) {
    if (!brief || problem.status !== 400) throw problem;
    brief = false;
    return page(query, signal);
  }
}

export async function show({ root, query, signal, setQuery, title }) {
  title("Jobs");
  let filter = read(query);
  let jobs = new Map(); // by id; ids sort by time
  let cursor = null;
  let generation = 0; // a slow answer to an earlier filter is dropped

  const live = h("span", { class: "live waiting" }, "connecting");
  const maps = h("select", { id: "f-map", onchange: () => setQuery({ map: maps.value }, { step: true }) }, h("option", { value: "" }, "all maps"));
  const states = h("select", { id: "f-state", onchange: () => setQuery({ state: states.value }, { step: true }) },
    h("option", { value: "" }, "all states"), STATES.map((state) => h("option", { value: state }, state)));
  const search = h("input", { id: "f-q", type: "search", placeholder: "id, image, error…", spellcheck: "false", oninput: () => {
    filter.q = search.value.trim();
    setQuery({ q: filter.q });
    draw();
  } });
  const body = h("tbody");
  const table = h("table", { class: "jobs stack" }, h("caption", { class: "unseen" }, "Jobs, newest first"),
    h("thead", {}, h("tr", {}, ["State", "Job", "Map", "Age", "Took", "Estimate", "Refiner", "Cost"].map((name) => h("th", { scope: "col" }, name)))), body);
  const before = h("div");
  const after = h("div", { class: "after" });
  fill(root,
    h("div", { class: "heading" }, h("h1", {}, "Jobs"), live),
    h("form", { class: "filters", role: "search", "aria-label": "Filter jobs", onsubmit: (event) => event.preventDefault() },
      h("label", { for: "f-map" }, "Map", maps), h("label", { for: "f-state" }, "State", states), h("label", { class: "grow", for: "f-q" }, "Search", search)),
    before, h("div", { class: "card flush" }, table), after);
  const rows = new Map();

  function controls() {
    if (filter.map && ![...maps.options].some((option) => option.value === filter.map)) maps.append(h("option", { value: filter.map }, filter.map));
    maps.value = filter.map;
    states.value = filter.state;
    if (search.value.trim() !== filter.q) search.value = filter.q;
  }

  function draw() {
    const all = [...jobs.values()].sort((a, b) => (a.id < b.id ? 1 : -1));
    const shown = all.filter((job) => matches(job, filter.q));
    const wanted = new Set(shown.map((job) => job.id));
    for (const [id, { row }] of rows) if (!wanted.has(id)) { row.remove(); rows.delete(id); }
    let place = body.firstChild;
    for (const job of shown) {
      const print = JSON.stringify([job.state, job.attempts, job.described, job.of, job.finished_at, job.error, job.usage]);
      let known = rows.get(job.id);
      if (!known) rows.set(job.id, known = { row: h("tr"), print: "" });
      // A row that has not changed is left alone, so that focus and selection stay.
      if (known.print !== print) { fill(known.row, cells(job)); known.print = print; }
      if (known.row === place) place = place.nextSibling;
      else body.insertBefore(known.row, place);
    }
    table.parentElement.hidden = shown.length === 0;
    fill(before, shown.length === 0 && nothing(all.length));
    const what = filter.q ? `${plural(shown.length, "match", "matches")} among the ${plural(all.length, "job")} loaded` : `${plural(all.length, "job")} loaded`;
    fill(after, all.length > 0 && h("span", { class: "muted" }, cursor ? what : `${what}; no older ones`),
      cursor && h("button", { type: "button", onclick: (event) => more(event.target) }, filter.q ? "Look through older jobs" : "Load older jobs"));
  }

  function nothing(loaded) {
    if (/^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$/i.test(filter.q)) {
      return empty("Not among the jobs loaded", h("p", {}, h("a", { href: `#/jobs/${filter.q.toLowerCase()}` }, "Open the job of this id")));
    }
    if (loaded) return empty("No match", h("p", {}, "Nothing that is loaded matches. Search looks at ids, maps, states, refiners and errors."));
    if (filter.map || filter.state) {
      return empty("No such jobs", h("p", {}, "No job fits these filters. ", h("a", { href: "#/jobs" }, "Show all jobs")));
    }
    return empty("No jobs yet", h("p", {}, "A job starts with each frame that is localized. ", h("a", { href: "#/try" }, "Try it with a picture"), ", or:"),
      command("whereabouts localize FRAME.jpg --map NAME"), h("p", {}, "No map yet?"), command("whereabouts index FOLDER --map NAME"));
  }

  async function load() {
    const mine = ++generation;
    try {
      const answer = await page({ map: filter.map, state: filter.state, limit: PAGE }, signal);
      if (mine !== generation) return;
      const last = answer.jobs.at(-1)?.id ?? "";
      // What was loaded below this page stays; what belongs into it and is not there is gone.
      const older = cursor && answer.next_cursor ? [...jobs.values()].filter((job) => job.id < last) : [];
      if (!older.length) cursor = answer.next_cursor;
      jobs = new Map([...answer.jobs, ...older].map((job) => [job.id, { ...progress.get(job.id), ...job }]));
      draw();
    } catch (problem) {
      if (isAbort(problem) || mine !== generation || problem.status === 401) return;
      if (jobs.size === 0) { table.parentElement.hidden = true; fill(before, failure(problem, load)); }
    }
  }

  async function more(button) {
    button.disabled = true;
    const mine = generation;
    try {
      const answer = await page({ map: filter.map, state: filter.state, cursor, limit: brief && filter.q ? 1000 : PAGE }, signal);
      if (mine !== generation) return draw();
      for (const job of answer.jobs) jobs.set(job.id, job);
      cursor = answer.next_cursor;
      draw();
    } catch (problem) {
      if (!isAbort(problem)) fill(after, failure(problem, () => more(button)));
    }
  }

  // How many pairs are described is told by events alone; it outlives the row that a reload replaces.
  const progress = new Map();
  let reload = null;
  let frame = 0;
  const soon = () => { reload ??= setTimeout(() => { reload = null; load(); }, brief ? 1500 : 5000); };
  let ended = 0;
  let said = 0; // a busy server is not read out job by job
  function changed(change) {
    if (filter.map && change.map !== filter.map) return;
    const { described, of, state, attempts, error } = change;
    if (ENDED.has(state)) {
      progress.delete(change.id);
      ended += 1;
      if (Date.now() - said > 15_000) {
        said = Date.now();
        announce(`${plural(ended, "job")} ended since this page was opened; the last one: ${state}`);
      }
      soon();
    } else {
      progress.set(change.id, { described, of });
    }
    const job = jobs.get(change.id);
    if (!job) return soon();
    Object.assign(job, { state, attempts, error, described, of });
    frame ||= requestAnimationFrame(() => { frame = 0; draw(); }); // many changes, one drawing
  }

  controls();
  table.parentElement.hidden = true;
  fill(before, loading("the jobs"));
  const first = load(); // before all else that asks: it is what the page is for

  signal.addEventListener("abort", () => { clearTimeout(reload); cancelAnimationFrame(frame); });
  follow("events", {
    signal,
    on(name, data) { if (name === "job") changed(data); else if (name === "missed") load(); },
    status(state) {
      live.className = `live ${state}`;
      live.textContent = state === "live" ? "live" : "reconnecting";
      if (state === "live" && jobs.size) load(); // what happened while nobody listened
    },
    failed(problem) { live.className = "live off"; live.textContent = "not live"; live.title = problem.detail; },
  });
  call("maps", { signal }).then((answer) => {
    for (const { name } of answer.maps) {
      if (![...maps.options].some((option) => option.value === name)) maps.append(h("option", { value: name }, name));
    }
    controls();
  }).catch(() => { /* the list of jobs tells what is wrong */ });

  await first;

  return (changedQuery) => {
    const next = read(changedQuery);
    const other = next.map !== filter.map || next.state !== filter.state;
    filter = next;
    controls();
    if (other) { jobs = new Map(); cursor = null; load(); } else draw();
  };
}

const read = (query) => ({ map: query.get("map") ?? "", state: query.get("state") ?? "", q: query.get("q") ?? "" });

function matches(job, text) {
  if (!text) return true;
  const all = [job.id, job.query_id, job.map, job.state, job.refiner, job.error, job.estimate?.image_id].join("\n").toLowerCase();
  return text.toLowerCase().split(/\s+/).every((word) => all.includes(word));
}

function cells(job) {
  const took = job.finished_at && job.started_at ? duration(Date.parse(job.finished_at) - Date.parse(job.started_at)) : "–";
  const pairs = !ENDED.has(job.state) && job.of ? ` ${count(job.described)} of ${count(job.of)} pairs` : "";
  const cell = (label, ...children) => h("td", { "data-label": label, class: `c-${label.toLowerCase()}` }, children);
  return [
    cell("State", badge(job.state), pairs && h("span", { class: "muted small" }, pairs)),
    cell("Job", h("a", { href: `#/jobs/${job.id}`, "aria-label": `Job ${shortId(job.id)} in ${job.map}` }, h("code", {}, shortId(job.id))),
      job.error && h("div", { class: "muted small clip" }, job.error)),
    cell("Map", job.map),
    cell("Age", timeAgo(job.created_at)),
    cell("Took", took),
    cell("Estimate", job.estimate ? [job.estimate.image_id, h("span", { class: job.estimate.known ? "sure" : "muted" }, ` ${percent(job.estimate.confidence)}`)] : "–"),
    cell("Refiner", job.refiner),
    cell("Cost", h("span", { class: job.usage.calls || job.usage.cached ? null : "muted" }, cost(job.usage))),
  ];
}
