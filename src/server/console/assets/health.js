// The health of the server: the last hour, queues, spending, recent errors, and configuration.

import { call, isAbort } from "./api.js";
import { chart } from "./chart.js";
import { facts, failure, fill, h, loading, meter } from "./dom.js";
import { ago, bytes, cost, count, duration, percent, plural, short, timeAgo } from "./format.js";

const EVERY = 10_000;

export async function show({ root, signal, title }) {
  title("Health");
  const heading = h("div", { class: "heading" }, h("h1", {}, "Health"));
  const body = h("div", { class: "view" }, loading("the status"));
  fill(root, heading, body);
  let opened = new Set(); // the <details> that stay open across an update
  let printed = "";
  // Only connection and authentication problems replace the whole page; others are shown in their section.
  const optional = (path) => call(path, { signal }).catch((problem) => { if (isAbort(problem) || problem.status === 401 || problem.status === 0) throw problem; return problem; });

  async function load() {
    const [status, usage] = await Promise.all([optional("status"), optional("usage?days=30")]);
    const print = JSON.stringify([status, usage], (name, value) => (name === "now" ? undefined : value));
    if (print === printed) return;
    const stops = () => [...body.querySelectorAll("summary, a, [tabindex]")];
    const before = stops().map((one) => one.scrollTop);
    const focused = stops().indexOf(document.activeElement);
    opened = new Set([...body.querySelectorAll("details[open]")].map((one) => one.dataset.name ?? one.closest("section")?.querySelector("h2")?.textContent));
    printed = print;
    fill(body, status instanceof Error ? without(status, usage) : drawn(status, usage));
    for (const one of body.querySelectorAll("details")) {
      if (opened.has(one.dataset.name ?? one.closest("section")?.querySelector("h2")?.textContent)) one.open = true;
    }
    // Restore scroll positions and focus after an update.
    stops().forEach((one, at) => { if (before[at]) one.scrollTop = before[at]; });
    if (focused >= 0) stops()[focused]?.focus({ preventScroll: true });
  }

  const turn = async () => {
    try { if (!document.hidden) await load(); } catch (problem) {
      if (isAbort(problem) || problem.status === 401) return;
      if (!printed) fill(body, failure(problem));
    }
    if (!signal.aborted) timer = setTimeout(turn, EVERY);
  };
  let timer = 0;
  signal.addEventListener("abort", () => clearTimeout(timer));
  await turn();
}

function without(problem, usage) {
  const told = problem.status === 404 ? h("div", { class: "notice warn" }, h("strong", {}, "This server has no status endpoint"), h("p", {}, "It is older than this page. Its metrics are at ", h("a", { href: "metrics" }, "/metrics"), "."))
    : failure(problem);
  return [told, spending(null, usage)];
}

function stat(name, value, ...more) {
  return h("section", { class: "card stat" }, h("h2", {}, name), h("div", { class: "value" }, value), more);
}

const small = (text) => h("div", { class: "muted small" }, text);

function drawn(status, usage) {
  const { minutes, jobs, pictures } = status;
  const sum = (field) => minutes.reduce((all, minute) => all + (minute[field] ?? 0), 0);
  const frames = sum("frames");
  const [requests, errors, failed, ended] = ["requests", "errors", "jobs_failed", "jobs_ended"].map(sum);
  const slow = minutes.filter((minute) => minute.p95_ms !== null);
  const worst = slow.reduce((most, minute) => Math.max(most, minute.p95_ms), 0);
  // The median of the minute medians, weighted by frames: accurate enough for one number.
  const middle = () => {
    const sorted = [...slow].sort((a, b) => a.p50_ms - b.p50_ms);
    let left = frames / 2;
    return sorted.find((minute) => (left -= minute.frames) <= 0)?.p50_ms ?? sorted.at(-1)?.p50_ms;
  };
  const now = Date.parse(status.now);
  const quiet = "Nothing in the last hour.";
  return [
    h("div", { class: "stats" },
      stat("Latency", slow.length ? duration(middle()) : "–", small(slow.length ? `median of the last hour; worst p95 of a minute ${duration(worst)}` : "no frames in the last hour")),
      stat("Throughput", plural(frames, "frame"), small(`in the last hour; ${plural(requests, "request")}, ${plural(errors, "error")}`)),
      stat("Jobs open", count(jobs.open), small(`of ${count(jobs.limit)}; ${count(ended)} ended in the last hour, ${count(failed)} failed`), meter(jobs.open, jobs.limit, "Jobs open")),
      stat("Pictures waiting", count(pictures.open), small(`of ${count(pictures.limit)}`), meter(pictures.open, pictures.limit, "Pictures waiting")),
      stat("On disk", bytes(status.db_bytes), small(status.free_bytes === null || status.free_bytes === undefined ? "" : `${bytes(status.free_bytes)} free`)),
      stat("Uptime", ago(status.started_at, now).replace(" ago", ""), small(`version ${status.version}`))),
    h("div", { class: "charts" },
      chart({ title: "Latency", unit: "ms", minutes, now, summary: slow.length ? `Median ${duration(middle())}, worst p95 of a minute ${duration(worst)}.` : quiet,
        series: [{ name: "p50", of: (minute) => minute.p50_ms, kind: "line", look: "a" }, { name: "p95", of: (minute) => minute.p95_ms, kind: "line", look: "b" }] }),
      chart({ title: "Requests", unit: "per minute", minutes, now, summary: requests ? `${plural(requests, "request")}, ${plural(errors, "error")} in the last hour.` : quiet,
        series: [{ name: "requests", of: (minute) => minute.requests, kind: "bar", look: "" }, { name: "errors", of: (minute) => minute.errors, kind: "bar", look: "bad" }] }),
      chart({ title: "Jobs", unit: "ended per minute", minutes, now, summary: ended ? `${plural(ended, "job")} ended, ${count(failed)} failed in the last hour.` : quiet,
        series: [{ name: "ended", of: (minute) => minute.jobs_ended, kind: "bar", look: "" }, { name: "failed", of: (minute) => minute.jobs_failed, kind: "bar", look: "bad" }] }),
    ),
    troubles(status.errors),
    h("div", { class: "charts" }, spending(status.today, usage), h("section", { class: "card" }, h("h2", {}, "Configured"), facts(
      ["Refiner", status.refiner ?? "off: answers are not refined"], ["API keys", status.keys_required ? "required" : "not required: anyone who can reach the server has full access"],
      ["Models", status.models.map((model) => `${model.name} (${model.provider}, ${model.precision})`).join("; ") || "none loaded"], ["Default model", status.default_model],
      ["Map background", status.tiles ? "configured" : "none"]),
      h("details", { "data-name": "settings" }, h("summary", {}, "All settings"), h("pre", { class: "settings", tabindex: "0", "aria-label": "Settings" }, h("code", {}, status.settings))))),
  ];
}

function spending(today, usage) {
  const told = usage instanceof Error ? null : usage;
  today ??= told?.today ?? null;
  const share = (spent, limit, unit) => h("span", {}, `${unit(spent)}${limit === null || limit === undefined ? ", no limit" : ` of ${unit(limit)}`}`, limit ? meter(spent, limit, "Spent") : null);
  const total = told?.total.usage;
  const pairs = total ? total.calls + total.cached : 0;
  return h("section", { class: "card" }, h("h2", {}, "Budget and cache"),
    today ? facts(["Tokens today", share(today.tokens, today.token_limit, short)], ["Money today", share(today.money, today.money_limit, (value) => value.toFixed(2))],
      ["Calls", today.suspended ? "suspended, because the latest calls failed" : "allowed"]) : h("p", { class: "muted" }, "No external model is used, so nothing is spent."),
    total && pairs > 0 && facts(["Last 30 days", cost(total)], ["From the cache", percent(total.cached / pairs)], ["Money", told.total.money.toFixed(2)]),
    usage instanceof Error && h("p", { class: "muted" }, usage.detail));
}

function troubles(errors) {
  return h("section", { class: "card" }, h("h2", {}, "Last errors"), errors.length
    ? h("table", { class: "stack" }, h("thead", {}, h("tr", {}, ["When", "Where", "What", "Times"].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, errors.map((error) => h("tr", {}, h("td", { "data-label": "When" }, timeAgo(error.at)), h("td", { "data-label": "Where" }, h("code", {}, error.where)), h("td", { "data-label": "What" }, error.detail), h("td", { "data-label": "Times" }, count(error.count ?? 1))))))
    : h("p", { class: "muted" }, "None since the server started."));
}
