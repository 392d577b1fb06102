// The live list of jobs: one event stream for all of them, a reload of the first page when a job ends, and no
// request per row. The search runs on the server.

import { address, call, follow, isAbort } from "./api.js";
import { announce, badge, command, empty, failure, fill, h, loading } from "./dom.js";
import { cost, count, downTo, duration, plural, shortId, timeAgo } from "./format.js";

const PAGE = 50;
const STATES = ["queued", "running", "succeeded", "degraded", "failed", "cancelled"];
const ENDED = new Set(["succeeded", "degraded", "failed", "cancelled"]);

const LONGEST_SEARCH = 200; // characters; the limit of the server
const UUID = /^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$/i;

/** Fetches a page of the jobs that match a filter, without their descriptions. */
const page = ({ map, state, q }, cursor, signal) => call(address(["jobs"], { map, state, q, cursor, limit: PAGE, brief: "true" }), { signal });

export async function show({ root, query, signal, setQuery, title }) {
  title("Jobs");
  let filter = read(query);
  let jobs = new Map(); // by id; ids sort by time
  let cursor = null; // the next page of older jobs; null at the end
  let loaded = false; // whether `cursor` is valid
  let want = PAGE; // number of jobs to look for
  let generation = 0; // a late response to an earlier filter is dropped

  const live = h("span", { class: "live waiting" }, "connecting");
  const maps = h("select", { id: "f-map", onchange: () => setQuery({ map: maps.value }, { step: true }) }, h("option", { value: "" }, "all maps"));
  const states = h("select", { id: "f-state", onchange: () => setQuery({ state: states.value }, { step: true }) },
    h("option", { value: "" }, "all states"), STATES.map((state) => h("option", { value: state }, state)));
  let typing = null;
  const search = h("input", { id: "f-q", type: "search", placeholder: "id, image, error, words of a description…", maxlength: LONGEST_SEARCH, spellcheck: "false", oninput: () => {
    clearTimeout(typing);
    typing = setTimeout(typed, 300);
  } });
  function typed() {
    clearTimeout(typing);
    typing = null;
    const q = search.value.trim();
    if (q === filter.q) return;
    setQuery({ q });
    ask({ ...filter, q });
  }
  const body = h("tbody");
  const table = h("table", { class: "jobs stack" }, h("caption", { class: "unseen" }, "Jobs, newest first"),
    h("thead", {}, h("tr", {}, ["State", "Job", "Map", "Age", "Took", "Estimate", "Refiner", "Cost"].map((name) => h("th", { scope: "col" }, name)))), body);
  const before = h("div");
  const after = h("div", { class: "after" });
  fill(root,
    h("div", { class: "heading" }, h("h1", {}, "Jobs"), live),
    h("form", { class: "filters", role: "search", "aria-label": "Filter jobs", onsubmit: (event) => { event.preventDefault(); typed(); } },
      h("label", { for: "f-map" }, "Map", maps), h("label", { for: "f-state" }, "State", states), h("label", { class: "grow", for: "f-q" }, "Search", search)),
    before, h("div", { class: "card flush" }, table), after);
  const rows = new Map();

  function controls() {
    if (filter.map && ![...maps.options].some((option) => option.value === filter.map)) maps.append(h("option", { value: filter.map }, filter.map));
    maps.value = filter.map;
    states.value = filter.state;
    if (typing === null && search.value.trim() !== filter.q) search.value = filter.q;
  }

  function draw() {
    const shown = [...jobs.values()].sort((a, b) => (a.id < b.id ? 1 : -1));
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
    const searching = Boolean(filter.q && cursor && shown.length < want);
    const direct = shown.length === 0 && UUID.test(filter.q) && h("p", {}, h("a", { href: `#/jobs/${filter.q.toLowerCase()}` }, "Open the job of this id"));
    fill(before, direct, shown.length === 0 && (searching ? loading("older jobs") : nothing()));
    body.removeAttribute("aria-busy");
    const what = filter.q ? plural(shown.length, "job found", "jobs found") : `${plural(shown.length, "job")} loaded`;
    fill(after, shown.length > 0 && h("span", { class: "muted" }, searching ? `${what}, searching older ones…` : cursor ? what : `${what}; no older ones`),
      cursor && !searching && h("button", { type: "button", onclick: (event) => more(event.target) }, filter.q ? "Search older jobs" : "Load older jobs"));
  }

  function nothing() {
    if (filter.q) {
      return empty("No match", h("p", {}, "No job that matches the filters contains this text. The search covers the ids of jobs, queries and candidates, maps, states, refiners, errors, reasoning and descriptions."));
    }
    if (filter.map || filter.state) {
      return empty("No such jobs", h("p", {}, "No job matches these filters. ", h("a", { href: "#/jobs" }, "Show all jobs")));
    }
    return empty("No jobs yet", h("p", {}, "Each localized frame starts a job. ", h("a", { href: "#/try" }, "Try it with a picture"), ", or:"),
      command("whereabouts localize FRAME.jpg --map NAME"), h("p", {}, "No map yet?"), command("whereabouts index FOLDER --map NAME"));
  }

  async function load() {
    const mine = ++generation;
    try {
      const answer = await page(filter, null, signal);
      if (mine !== generation) return;
      const end = answer.next_cursor;
      // Keep the jobs loaded below this page; jobs missing from the page itself are gone.
      const older = end && loaded && (cursor === null || cursor < end) ? [...jobs.values()].filter((job) => job.id < end) : null;
      if (!older) cursor = end;
      loaded = true;
      jobs = new Map([...answer.jobs, ...older ?? []].map((job) => [job.id, { ...progress.get(job.id), ...job }]));
      draw();
      fillUp(mine);
    } catch (problem) {
      if (isAbort(problem) || mine !== generation || problem.status === 401) return;
      if (jobs.size === 0) { table.parentElement.hidden = true; fill(before, failure(problem, load)); }
    }
  }

  async function further(mine) {
    const answer = await page(filter, cursor, signal);
    if (mine !== generation) return;
    for (const job of answer.jobs) jobs.set(job.id, job);
    cursor = answer.next_cursor;
    draw();
  }

  /** Continues a search until there are enough jobs: the server examines a bounded number of jobs per page. */
  async function fillUp(mine) {
    try {
      while (mine === generation && filter.q && cursor && jobs.size < want) await further(mine);
    } catch (problem) {
      if (isAbort(problem) || mine !== generation) return;
      if (jobs.size === 0) fill(before);
      fill(after, failure(problem, () => fillUp(mine)));
    }
  }

  async function more(button) {
    button.disabled = true;
    const mine = generation;
    want = jobs.size + PAGE;
    try {
      await further(mine);
      if (mine !== generation) draw();
      fillUp(mine);
    } catch (problem) {
      if (!isAbort(problem)) fill(after, failure(problem, () => more(button)));
    }
  }

  /** Shows the jobs of another filter. */
  function ask(next) {
    filter = next;
    jobs = new Map();
    cursor = null;
    loaded = false;
    want = PAGE;
    body.setAttribute("aria-busy", "true"); // the list still shows the previous filter
    load();
  }

  // Progress in pairs comes from events only; it is kept when a reload replaces the row.
  const progress = new Map();
  let reload = null;
  let frame = 0;
  // A search is more expensive for the server than a list.
  const soon = () => { reload ??= setTimeout(() => { reload = null; load(); }, filter.q ? 5000 : 1500); };
  let ended = 0;
  let said = 0; // limits screen reader announcements on a busy server
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
    // It may no longer match the filter.
    if ((filter.q || filter.state) && (job.state !== state || job.error !== error)) soon();
    Object.assign(job, { state, attempts, error, described, of });
    frame ||= requestAnimationFrame(() => { frame = 0; draw(); }); // coalesce many changes into one redraw
  }

  controls();
  table.parentElement.hidden = true;
  fill(before, loading("the jobs"));
  const first = load(); // before all other requests: it is the main content

  signal.addEventListener("abort", () => { clearTimeout(reload); clearTimeout(typing); cancelAnimationFrame(frame); });
  follow("events", {
    signal,
    on(name, data) { if (name === "job") changed(data); else if (name === "missed") load(); },
    status(state) {
      live.className = `live ${state}`;
      live.textContent = state === "live" ? "live" : "reconnecting";
      if (state === "live" && loaded) load(); // catch up on events missed while disconnected
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
    const same = next.map === filter.map && next.state === filter.state && next.q === filter.q;
    if (!same) ask(next);
    controls();
  };
}

function read(query) {
  const q = (query.get("q") ?? "").trim().slice(0, LONGEST_SEARCH);
  return { map: query.get("map") ?? "", state: query.get("state") ?? "", q };
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
    cell("Estimate", job.estimate ? [job.estimate.image_id, h("span", { class: job.estimate.known ? "sure" : "muted" }, job.estimate.confidence == null ? " not measured yet" : ` ${downTo(job.estimate.confidence)}`)] : "–"),
    cell("Refiner", job.refiner),
    cell("Cost", h("span", { class: job.usage.calls || job.usage.cached ? null : "muted" }, cost(job.usage))),
  ];
}
