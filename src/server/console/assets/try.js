// Localizes a picture: shows the estimate, the similar images, and then the refinement pair by pair.

import { address, call, contentOf, follow, isAbort, picture } from "./api.js";
import { announce, badge, command, confidenceLine, empty, facts, failure, fill, h } from "./dom.js";
import { confidence, count, duration, knownOrNot, pose, shortId } from "./format.js";
import { moved } from "./pair.js";
import { apart } from "./words.js";

const K = 10;

export async function show({ root, query, signal, setQuery, title }) {
  title("Try it");
  const { maps } = await call("maps", { signal });
  if (!maps.length) {
    fill(root, h("h1", {}, "Try it"), empty("No map yet", h("p", {}, "A picture is localized in a map. Create one first:"), command("whereabouts index FOLDER --map NAME")));
    return;
  }
  const map = h("select", { id: "try-map", onchange: () => setQuery({ map: map.value, job: "" }) }, maps.map(({ name, images }) => h("option", { value: name }, `${name} (${count(images)})`)));
  const wanted = query.get("map");
  map.value = maps.some(({ name }) => name === wanted) ? wanted : maps.reduce((most, one) => (one.images > most.images ? one : most)).name;
  const refine = h("input", { type: "checkbox", id: "try-refine", checked: true });
  const choose = (id, label, name, attributes) => [
    h("input", { type: "file", id, accept: "image/*", ...attributes, onchange: (event) => { const [file] = event.target.files; event.target.value = ""; if (file) ask(file); } }),
    h("label", { for: id, class: `button ${name}` }, label)];
  const out = h("div", { class: "view" });
  const drop = h("div", { class: "drop" },
    h("div", { class: "actions" }, choose("try-file", "Choose a picture", "primary", {}), choose("try-camera", "Use the camera", "", { capture: "environment" })),
    h("p", { class: "muted" }, "or drop one here, or paste it. It is sent unchanged: JPEG, PNG, WebP, TIFF, BMP, GIF or PNM."));
  fill(root, h("h1", {}, "Try it"),
    h("form", { class: "filters", "aria-label": "Options", onsubmit: (event) => event.preventDefault() }, h("label", { for: "try-map" }, "Map", map), h("label", { class: "check", for: "try-refine" }, refine, "Refine the answer in a job")),
    drop, out);

  const earlier = query.get("job");
  if (earlier) fill(out, h("p", {}, "The last picture: ", h("a", { href: `#/jobs/${encodeURIComponent(earlier)}` }, "its job"), "."));

  const over = (on) => (event) => { event.preventDefault(); drop.classList.toggle("over-it", on); };
  // Anywhere on the page: a picture dropped next to the target must not replace the page.
  addEventListener("dragover", over(true), { signal });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) drop.classList.remove("over-it"); }, { signal });
  addEventListener("drop", (event) => { over(false)(event); const [file] = event.dataTransfer.files; if (file) ask(file); }, { signal });
  addEventListener("paste", (event) => { const [file] = event.clipboardData.files; if (file) { event.preventDefault(); ask(file); } }, { signal });

  let asking = new AbortController();
  signal.addEventListener("abort", () => asking.abort());

  async function ask(file) {
    asking.abort();
    const mine = asking = new AbortController();
    const source = URL.createObjectURL(file);
    const shown = h("img", { alt: "Your picture", src: source });
    const own = h("div", { class: "picture here" }, shown);
    shown.addEventListener("load", () => URL.revokeObjectURL(source));
    shown.addEventListener("error", () => { URL.revokeObjectURL(source); own.replaceChildren("The browser cannot show this picture."); });
    const told = h("div", {}, h("p", { class: "muted" }, "Localizing…"));
    const best = h("figure", {}, h("div", { class: "picture" }));
    const rest = h("div");
    fill(out, h("section", { class: "card", "aria-label": "Answer" }, h("div", { class: "guess" }, h("figure", {}, own, h("figcaption", {}, "Your picture")), best, told)), rest);
    const start = performance.now();
    let answer;
    try {
      answer = await call(address(["localize"], { map: map.value, k: K, refine: refine.checked ? "async" : "off" }),
        { method: "POST", body: file, headers: { "Content-Type": file.type || "application/octet-stream" }, signal: mine.signal });
    } catch (problem) {
      if (isAbort(problem)) return;
      best.remove();
      const type = problem.status === 415 ? h("p", { class: "muted" }, "Phones may take pictures as HEIC; set the camera to the most compatible format.") : null;
      fill(told, failure(problem, problem.status === 415 ? null : () => ask(file)), type);
      return;
    }
    const round = performance.now() - start;
    setQuery({ map: answer.map, job: answer.job?.id });
    estimated(best, told, answer, answer.estimate, { round });
    announce(answer.estimate ? `Answered: ${answer.estimate.image_id}, ${confidence(answer.estimate.confidence)}.` : "Answered: no candidates.");
    if (!answer.candidates.length) {
      fill(rest, empty("Nothing to compare with", h("p", {}, "This map has no images yet:"), command(`whereabouts index FOLDER --map ${answer.map}`)));
      return;
    }
    candidates(rest, answer, mine.signal, (job) => estimated(best, told, answer, job.estimate ?? answer.estimate, { round, job }));
  }

  let pictured = "";
  function estimated(best, told, answer, estimate, { round, job }) {
    const timing = answer.timing_ms;
    const print = `${answer.query_id} ${estimate?.image_id}`;
    if (print !== pictured) {
      pictured = print;
      fill(best, estimate && [picture(contentOf(answer.map, estimate.image_id, 800), `The image ${estimate.image_id}`, { signal, gone: "The image is no longer in the map." }),
        h("figcaption", {}, "Most similar: ", h("code", {}, estimate.image_id))]);
    }
    fill(told, h("h2", {}, job ? "Refined estimate" : "Estimate"),
      estimate ? confidenceLine(estimate) : h("p", {}, "None: the map has no images."),
      estimate && h("p", {}, knownOrNot(estimate)),
      (answer.warnings ?? []).map((warning) => h("div", { class: "notice warn" }, h("strong", {}, "Damaged picture"), h("p", {}, warning))),
      facts(["Pose", estimate && pose(estimate.pose)], ["Answered in", `${duration(timing.total)} (decode ${duration(timing.decode)}, extract ${duration(timing.extract)}, search ${duration(timing.search)})`],
        ["Round trip", duration(round)], ["Model", answer.model]));
  }

  /** Shows the candidates, each with the description of its pair once it has arrived. */
  function candidates(rest, answer, stop, refined) {
    const status = h("p", { class: "muted", role: "status" });
    const list = h("ol", { class: "answers" });
    const cards = new Map();
    const card = (image, similarity) => {
      const head = h("div", {}, h("strong", {}, image));
      const words = h("div");
      const item = h("li", { class: "card" }, picture(contentOf(answer.map, image, 320), `Candidate ${image}`, { signal: stop, gone: "gone" }),
        h("div", {}, head, similarity !== null && h("div", { class: "muted small" }, `similarity ${similarity.toFixed(3)}`), words));
      cards.set(image, { item, head, words });
      return item;
    };
    for (const candidate of answer.candidates) {
      list.append(card(candidate.image_id, candidate.similarity));
      fill(cards.get(candidate.image_id).head, h("strong", {}, `${candidate.rank}. ${candidate.image_id}`));
    }
    const { job } = answer;
    fill(rest, h("div", { class: "heading" }, h("h2", {}, "Candidates"), job && h("a", { class: "heading-end button", href: `#/jobs/${encodeURIComponent(job.id)}` }, "Open the job ", h("code", {}, shortId(job.id)))),
      answer.no_job && h("div", { class: "notice warn" }, h("strong", {}, "No refinement"), h("p", {}, answer.no_job.detail)), status, list);
    if (!job) return;
    status.textContent = "The refinement is queued.";
    const describe = ({ image_id: image, text }) => {
      // A job may compare more candidates than were requested.
      if (!cards.has(image)) list.append(card(image, null));
      const found = apart(text);
      fill(cards.get(image).words, h("p", { class: "verdict" }, found?.verdict ?? `${text.slice(0, 160)}${text.length > 160 ? "…" : ""}`), h("details", {}, h("summary", {}, "Description"), h("p", { class: "told small" }, text)));
    };
    follow(address(["jobs", job.id, "events"]), {
      signal: stop,
      on(name, data) {
        if (name === "state") status.textContent = data.error ? `The refinement is ${data.state}: ${data.error}` : `The refinement is ${data.state}.`;
        if (name === "description") { describe(data.description); status.textContent = `${count(data.described)} of ${count(data.of)} pairs described.`; }
        if (name !== "end") return false;
        finish(data);
        return true;
      },
      failed(problem) { fill(status, failure(problem)); },
    });

    function finish(ended) {
      fill(status, badge(ended.state), " ", ended.error ?? ended.reasoning ?? "");
      for (const candidate of ended.ranking ?? []) {
        if (!cards.has(candidate.image_id)) list.append(card(candidate.image_id, null));
        const { item, head } = cards.get(candidate.image_id);
        fill(head, h("strong", {}, `${candidate.rank}. ${candidate.image_id}`), " ", moved(candidate));
        item.classList.toggle("first", candidate.rank === 1);
        list.append(item); // in the refined order
      }
      refined(ended);
      announce(`The refinement has ended: ${ended.state}.${ended.ranking ? ` First: ${ended.ranking[0]?.image_id}.` : ""}`);
    }
  }
}
