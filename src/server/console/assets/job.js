// One job: its result, the frame next to each candidate, and its cost. An open job is followed live.

import { address, call, contentOf, follow, frameOf, isAbort, picture } from "./api.js";
import { announce, badge, confidenceLine, facts, failure, fill, h, loading } from "./dom.js";
import { confidence, cost, count, duration, knownOrNot, moment, plural, pose, shortId, timeAgo } from "./format.js";
import { bought, moved, pictures, words } from "./pair.js";

const OPEN = ["queued", "running"];

export async function show({ root, argument: id, query, signal, setQuery, title }) {
  title(`Job ${shortId(id)}`);
  fill(root, h("h1", {}, "Job ", h("code", {}, shortId(id))), loading("the job"));
  let job = await call(address(["jobs", id]), { signal });
  let of = null;
  let chosen = query.get("pair");

  const head = h("div");
  const said = h("div", { role: "status" });
  const list = h("ol", { class: "candidates" });
  const stage = h("section", { class: "card stage", "aria-label": "The chosen pair" });
  const calls = h("div");
  fill(root, head, said, h("div", { class: "job-body" },
    h("section", { class: "card side", "aria-label": "Candidates" }, h("h2", {}, "Candidates"), list), stage), calls);

  const ended = () => !OPEN.includes(job.state);
  const describes = (image) => job.descriptions.find((description) => description.image_id === image);
  // Without a ranking, the described pairs are listed in coarse order.
  const candidates = () => job.ranking ?? job.descriptions.map(({ image_id: image }) => ({ image_id: image }));

  async function act(verb, button) {
    button.disabled = true;
    try {
      job = await call(address(["jobs", id, verb]), { method: "POST", signal });
      fill(said);
      announce(`The job is ${job.state}.`);
      drawAll();
      if (ended()) watching?.abort();
      else watch();
    } catch (problem) {
      if (!isAbort(problem)) fill(said, failure(problem));
      button.disabled = false;
    }
  }

  function drawHead() {
    const { created_at: made, started_at: started, finished_at: finished } = job;
    const span = (from, to) => (from && to ? duration(Math.max(0, Date.parse(to) - Date.parse(from))) : null);
    const estimate = job.estimate;
    const progress = !ended() && plural(job.descriptions.length, "pair") + (of ? ` of ${count(of)}` : "") + " described";
    fill(head,
      h("p", { class: "crumbs" }, h("a", { href: "#/jobs" }, "Jobs")),
      h("div", { class: "heading" }, h("h1", {}, "Job ", h("code", { title: id }, shortId(id))), badge(job.state),
        h("div", { class: "heading-end" },
          h("a", { class: "button", href: `#/maps/${encodeURIComponent(job.map)}?query=${encodeURIComponent(id)}` }, "Show on the map"),
          ["failed", "degraded", "cancelled"].includes(job.state) && h("button", { type: "button", onclick: (event) => act("retry", event.target) }, "Retry"),
          !ended() && h("button", { type: "button", onclick: (event) => act("cancel", event.target) }, "Cancel"))),
      job.error && h("div", { class: job.state === "failed" ? "notice bad" : "notice warn" },
        h("strong", {}, { failed: "The job failed", degraded: "Part of the ranking fell back to the coarse order", cancelled: "The job was cancelled" }[job.state] ?? "The job is waiting"),
        h("p", {}, job.error)),
      h("div", { class: "summary" },
        h("div", { class: "card answer" },
          picture(frameOf(id, 640), "The frame of this job", { signal, className: "small-picture", gone: "The frame is no longer stored, or this server does not serve frames." }),
          h("div", {}, h("h2", {}, "Estimate"),
            estimate ? confidenceLine(estimate) : h("p", { class: "muted" }, ended() ? "None." : "Available when the job has ended."),
            estimate && h("p", {}, knownOrNot(estimate)),
            estimate && h("p", {}, h("code", {}, estimate.image_id), h("br"), h("span", { class: "muted" }, pose(estimate.pose))),
            job.verdicts?.length > 0 && h("div", {}, h("h2", {}, "Verdicts"), job.verdicts.map((verdict) => h("p", {},
              h("strong", {}, verdict.refiner), ": ", h("code", {}, verdict.image_id), ` of ${plural(verdict.compared, "candidate")}, ${confidence(verdict.confidence)}`,
              verdict.certainty && ` (the model says: ${verdict.certainty})`, verdict.then && h("span", { class: "muted" }, `; ${verdict.then}`)))),
            job.reasoning && h("div", {}, h("h2", {}, "Reasoning"), job.reasoning.split(/\n+/).map((part) => h("p", { class: "told" }, part))))),
        h("div", { class: "card" }, facts(
          ["Map", h("a", { href: `#/maps/${encodeURIComponent(job.map)}` }, job.map)],
          ["Queued", h("span", {}, timeAgo(made), h("span", { class: "muted small" }, ` · ${moment(made)}`))],
          ["Waited", span(made, started)], ["Took", span(started, finished)],
          ["Refiner", job.refiner], ["Priority", job.priority === "normal" ? null : job.priority],
          ["Attempts", count(job.attempts)], ["Cost", cost(job.usage)], ["Progress", progress || null],
          ["Query", h("code", { class: "wrap" }, job.query_id)], ["Job", h("code", { class: "wrap" }, id)]))));
  }

  const links = new Map();
  function drawList() {
    const all = candidates();
    if (!all.some(({ image_id: image }) => image === chosen)) chosen = all[0]?.image_id ?? null;
    if (!all.length) {
      fill(list, h("li", { class: "muted" }, ended() ? "No pair was compared." : "Waiting for the first pair."));
      return fill(stage, h("p", { class: "muted" }, ended() ? "There is nothing to compare." : "Pairs appear here as they are described."));
    }
    // Cached by image, so that a new pair does not refetch the pictures of the others.
    fill(list, all.map((candidate) => {
      const image = candidate.image_id;
      if (!links.has(image)) {
        const thumb = picture(contentOf(job.map, image, 160), "", { signal, className: "thumb", gone: "gone" });
        links.set(image, { thumb, ranks: h("span", { class: "ranks" }) });
      }
      const { thumb, ranks } = links.get(image);
      if (candidate.rank) fill(ranks, h("b", {}, `${candidate.rank}`), h("span", { class: "muted" }, candidate.rank === candidate.coarse_rank ? " " : ` from ${candidate.coarse_rank} `), moved(candidate));
      else fill(ranks, h("span", { class: "muted" }, "not ranked yet"));
      const link = h("a", { href: here(image), "aria-current": image === chosen ? "true" : null, onclick: (event) => {
        if (event.metaKey || event.ctrlKey || event.shiftKey) return;
        event.preventDefault();
        choose(image);
      } }, thumb, h("span", { class: "who" }, ranks, h("span", { class: "name" }, image)));
      return h("li", {}, link);
    }));
  }
  const here = (image) => `#/jobs/${id}?pair=${encodeURIComponent(image)}`;

  function choose(image) {
    chosen = image;
    setQuery({ pair: image });
    for (const link of list.querySelectorAll("a")) {
      if (link.getAttribute("href") === here(image)) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
    drawStage();
  }

  let pairSignal = new AbortController();
  let staged = "";
  function drawStage() {
    if (!chosen) return;
    const all = candidates();
    const at = all.findIndex(({ image_id: image }) => image === chosen);
    const candidate = all[at];
    const print = JSON.stringify([chosen, candidate, describes(chosen), ended()]);
    if (print === staged) return;
    const sameImage = staged && JSON.parse(staged)[0] === chosen && JSON.parse(staged)[3] === ended();
    staged = print;
    const step = (by, name) => h("button", { type: "button", disabled: !all[at + by], onclick: () => { choose(all[at + by].image_id); stage.querySelector(all[at + 2 * by] ? `.${by > 0 ? "next" : "prior"}` : ".step:enabled")?.focus(); }, class: by > 0 ? "step next" : "step prior" }, name);
    const heading = h("div", { class: "heading" },
      h("h2", {}, candidate.rank ? `Rank ${candidate.rank}` : "Compared"),
      candidate.rank && h("span", {}, h("span", { class: "muted" }, `coarse rank ${candidate.coarse_rank} `), moved(candidate)),
      h("div", { class: "heading-end" }, step(-1, "Previous"), step(1, "Next")));
    // While pairs arrive, keep the pictures of the chosen pair and update only texts and ranks.
    if (sameImage && stage.children.length === 4) {
      stage.children[0].replaceWith(heading);
      stage.children[2].replaceWith(words(describes(chosen)));
      return;
    }
    pairSignal.abort();
    pairSignal = new AbortController();
    fill(stage, heading, pictures(job, chosen, { signal: pairSignal.signal }), words(describes(chosen)),
      h("p", { class: "muted small" }, pose(candidate.pose)));
  }
  signal.addEventListener("abort", () => pairSignal.abort());

  function drawCalls() {
    const priced = job.descriptions.some((one) => one.usage.calls || one.cached || one.stands_in);
    if (!priced) return fill(calls);
    const described = job.descriptions.reduce((sum, one) => sum + one.usage.calls, 0);
    const row = (name, what, usage, took) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, what),
      h("td", { class: "num" }, count(usage.prompt_tokens)), h("td", { class: "num" }, count(usage.completion_tokens)),
      h("td", { class: "num" }, took === null ? "–" : duration(took)));
    const rest = (field) => Math.max(0, job.usage[field] - job.descriptions.reduce((sum, one) => sum + one.usage[field], 0));
    fill(calls, h("section", { class: "card" }, h("h2", {}, "Calls"),
      h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Calls" }, h("table", { class: "calls" },
        h("thead", {}, h("tr", {}, ["Call", "Source", "Tokens sent", "received", "Took"].map((name) => h("th", { scope: "col" }, name)))),
        h("tbody", {}, job.descriptions.map((one) => row(one.image_id, bought(one), one.usage, one.took_ms)),
          job.usage.calls > described && row("Ranking and repeats", plural(job.usage.calls - described, "call"),
            { prompt_tokens: rest("prompt_tokens"), completion_tokens: rest("completion_tokens") }, job.reasoning_took_ms)))),
      job.usage.estimated > 0 && h("p", { class: "muted small" }, `The tokens of ${plural(job.usage.estimated, "call")} are estimated: the model's server did not count them.`)));
  }

  function drawAll() { drawHead(); drawList(); drawStage(); drawCalls(); }

  let watching = null;
  function watch() {
    watching?.abort();
    watching = new AbortController();
    follow(address(["jobs", id, "events"]), {
      signal: AbortSignal.any([signal, watching.signal]),
      on(name, data) {
        if (name === "state") {
          const news = data.state !== job.state || data.error !== job.error || data.attempts !== job.attempts;
          Object.assign(job, data);
          if (news) { announce(`The job is ${job.state}.`); drawHead(); }
        } else if (name === "description") {
          of = data.of;
          const at = job.descriptions.findIndex((one) => one.image_id === data.description.image_id);
          if (at < 0) job.descriptions.push(data.description);
          else job.descriptions[at] = data.description;
          const line = [...head.querySelectorAll("dt")].find((one) => one.textContent === "Progress")?.nextSibling;
          if (line) line.textContent = `${count(data.described)} of ${count(data.of)} pairs described`;
          drawList();
          drawStage();
        } else if (name === "end") {
          job = data;
          announce(`The job has ended: ${job.state}.`);
          drawAll();
          return true;
        }
        return false;
      },
      failed(problem) { fill(said, failure(problem)); },
    });
  }

  drawAll();
  if (!ended()) watch();
  return (next) => { const pair = next.get("pair"); if (pair && pair !== chosen) choose(pair); };
}
