// One map: its images on a plan, their coverage and age, a query overlay, and single images.

import { address, call, isAbort } from "./api.js";
import { announce, command, confirm, empty, facts, failure, fill, h, loading } from "./dom.js";
import { ago, confidence, count, metres, moment, plural, pose } from "./format.js";
import { imageCard, uploadCard } from "./images.js";
import { reindexed, searched } from "./maps.js";
import { Plan } from "./plan.js";
import { AGES } from "./points.js";
import { tracksCard } from "./tracks.js";

const PAGE = 1000;
const MOST = 100_000; // maximum number of images loaded automatically
const LISTED = 100;
const MARKED = 20; // maximum number of images with a searched text that are marked on the plan

export async function show({ root, argument: name, query, signal, setQuery, title, fail }) {
  title(`Map ${name}`);
  fill(root, h("h1", {}, name), loading("the map"));
  const [map, status] = await Promise.all([
    call(address(["maps", name]), { signal }),
    call("status", { signal }).catch((problem) => { if (isAbort(problem) || problem.status === 401) throw problem; return null; }),
  ]);
  const tiles = map.frame === "wgs84" ? status?.tiles : null;

  let images = [];
  let chosen = null;
  const canvas = h("canvas", { tabindex: "0", role: "application", "aria-label": `Plan of the images of ${name}`, "aria-describedby": "plan-keys" });
  const progress = h("p", { class: "muted", role: "status" });
  const covered = h("div");
  const asked = h("section", { class: "card", hidden: true, "aria-label": "The query" });
  const single = h("section", { class: "card chosen-image", hidden: true, "aria-label": "The chosen image", tabindex: "-1" });
  const legend = h("div", { class: "over legend" });
  const tool = (label, sign, act) => h("button", { type: "button", "aria-label": label, title: label, onclick: act }, sign);
  const overlay = h("input", { type: "checkbox", id: "coverage", onchange: () => { plan.coverage = overlay.checked; plan.touch(); } });
  const search = h("input", { id: "image-q", type: "search", placeholder: map.texts ? "id, tag or text of a sign" : "id or tag", maxlength: "100", spellcheck: "false", oninput: listSoon });
  const listed = h("p", { class: "muted small", role: "status" });
  const list = h("ul", { class: "images", tabindex: "-1" });
  const planCard = h("section", { class: "card plan", "aria-label": "Plan" }, canvas,
    h("div", { class: "plan-tools" }, tool("Zoom in", "+", () => plan.zoom(1.6)), tool("Zoom out", "−", () => plan.zoom(1 / 1.6)), tool("Show everything", "⤢", () => plan.fit(true))),
    legend, tiles && h("div", { class: "over attribution" }, tiles.attribution ?? ""));
  fill(root,
    h("p", { class: "crumbs" }, h("a", { href: "#/maps" }, "Maps")),
    h("div", { class: "heading" }, h("h1", {}, name), h("span", { class: "muted" }, plural(map.images, "image")),
      h("div", { class: "heading-end" }, h("a", { class: "button", href: `#/try?map=${encodeURIComponent(name)}` }, "Try a picture"), h("a", { class: "button", href: `#/jobs?map=${encodeURIComponent(name)}` }, "Its jobs"))),
    map.description && h("p", {}, map.description),
    progress,
    h("div", { class: "map-body" },
      h("div", {}, planCard, h("p", { id: "plan-keys", class: "muted small" }, "Drag or use the arrow keys to move, the wheel, two fingers or + and − to zoom, 0 to see everything. Click a point for its picture; the list shows the same images.")),
      h("div", { class: "map-side" }, single, asked,
        h("section", { class: "card" }, h("h2", {}, "Images in view"), h("label", { for: "image-q" }, "Search all images", search), listed, list),
        h("section", { class: "card" }, h("h2", {}, "Coverage and age"), h("label", { class: "check", for: "coverage" }, overlay, "Mark 10 m around each image"), covered),
        uploadCard(map, { signal, centre: () => plan.poseOfCentre(), added(image) { images = [...images.filter((one) => one.id !== image.id), image]; changed(); choose(image); } }),
        settings())));

  const plan = new Plan(canvas, { signal, picked: choose, moved: listSoon, tiles: tiles?.url ?? null });
  single.after(tracksCard(name, { plan, signal, query, setQuery }));

  function vocabulary(of) {
    if (of.source === "own") return `the map's own, fitted on ${plural(of.images, "image")}`;
    return of.reason ? `the model's: ${of.reason}` : "the model's";
  }

  function read({ read: done, failed, waiting, lines }) {
    const parts = [`read in ${plural(done, "image")}, ${plural(lines, "line")}`];
    if (failed) parts.push(`${count(failed)} cannot be read`);
    if (waiting) parts.push(`${count(waiting)} waiting`);
    return parts.join("; ");
  }

  function settings() {
    return h("section", { class: "card" }, h("h2", {}, "This map"), facts(
      ["Scene", map.scene], ["Poses", map.frame], ["Model", `${map.model}, ${map.precision} precision`], ["Descriptor", `${map.descriptor}, ${count(map.dim)} dimensions`],
      ...(map.vocabulary ? [["Vocabulary", vocabulary(map.vocabulary)]] : []),
      ["Text", map.texts ? read(map.texts) : null], ["Search", searched(map)], ["Reindex", reindexed(map)],
      ["Confidence", map.calibration ? `calibrated on ${plural(map.calibration.asked, "image")}` : "not calibrated yet"], ["Created", moment(map.created_at)]),
      h("details", {}, h("summary", {}, "Delete this map"), h("p", {}, "Needs the role admin. Deletes all images of the map."),
        h("button", { type: "button", class: "danger", onclick: remove }, "Delete the map…")));
  }

  async function remove() {
    const sure = await confirm({ title: `Delete the map ${name}?`, text: `This deletes its ${plural(map.images, "image")}. Only a backup can restore them.`, action: "Delete the map", word: name });
    if (!sure) return;
    try {
      await call(address(["maps", name]), { method: "DELETE", signal });
      announce("The map is deleted.");
      location.hash = "#/maps";
    } catch (problem) { if (!isAbort(problem)) fill(progress, failure(problem)); }
  }

  function choose(image, { focus = false } = {}) {
    chosen = image;
    plan.choose(image);
    setQuery({ image: image?.id });
    single.hidden = !image;
    for (const button of list.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.id === image?.id));
    if (!image) return;
    if (image.pose) plan.goTo(image.pose);
    fill(single, imageCard(map, image, { signal, close: () => { choose(null); canvas.focus(); }, corrected(next) {
      images = images.map((one) => (one.id === image.id ? next : one));
      changed();
      choose(next);
    }, removed() {
      images = images.filter((one) => one.id !== image.id);
      choose(null);
      changed();
    } }));
    if (focus) single.focus();
    else announce(`Image ${image.id}, ${pose(image.pose)}`);
  }

  let listing = 0;
  function listSoon() {
    // Debounced: during a drag, the list is not redrawn with each frame.
    clearTimeout(listing);
    listing = setTimeout(() => { drawList(); searchTexts(); }, 200);
  }
  // What was read in images, for the text that is in the field.
  let signs = { text: "", images: [], lines: new Map(), said: "" };
  let asking = null;
  async function searchTexts() {
    const text = search.value.trim();
    if (!map.texts || text === signs.text) return;
    asking?.abort();
    asking = new AbortController();
    signs = { text, images: [], lines: new Map(), said: "" };
    if (text) {
      try {
        const answer = await call(address(["maps", name, "images"], { text, limit: LISTED }), { signal: AbortSignal.any([signal, asking.signal]) });
        const unread = answer.unread ? `; the text in ${plural(answer.unread, "image")} is not read yet` : "";
        signs = { text, images: answer.images, said: unread, lines: new Map(answer.matches.map((one) => [one.image_id, one.lines.map((line) => line.text).join(" / ")])) };
      } catch (problem) {
        if (isAbort(problem)) return;
        // A text without letters can still be part of an id.
        signs.said = problem.status === 422 ? "" : `; ${problem.detail}`;
      }
    }
    if (!query.get("query")) plan.setMarkers(signs.images.slice(0, MARKED).map((image, at) => ({ pose: image.pose, label: String(at + 1), kind: "candidate" })));
    drawList();
  }
  signal.addEventListener("abort", () => clearTimeout(listing));
  function drawList() {
    const text = search.value.trim().toLowerCase();
    const named = text ? images.filter((image) => [image.id, ...(image.tags ?? [])].join("\n").toLowerCase().includes(text)) : [...plan.inView(), ...images.filter((image) => !image.pose)];
    named.sort((a, b) => (a.id < b.id ? -1 : 1));
    const found = text ? [...signs.images, ...named.filter((image) => !signs.lines.has(image.id))] : named;
    const what = text ? `${plural(found.length, "image")} found` : `${plural(found.length, "image")} of ${count(images.length)}`;
    let told = found.length > LISTED ? `${what}; the first ${LISTED} are listed, zoom in or search for the others` : what;
    if (text) told += signs.said;
    else if (!found.length && images.length) told += "; press 0 on the plan, or ⤢, to show everything";
    if (listed.textContent !== told) listed.textContent = told;
    fill(list, found.slice(0, LISTED).map((image) => h("li", {}, h("button", { type: "button", "data-id": image.id, "aria-pressed": String(image.id === chosen?.id), onclick: () => choose(image, { focus: true }) },
      h("span", {}, image.id), h("span", { class: "muted" }, (text && signs.lines.get(image.id)) || (image.pose ? ago(image.captured_at ?? image.created_at) : "no pose"))))));
  }

  function changed() {
    plan.setImages(images);
    const posed = plan.points.length;
    const cover = plan.points.coverage();
    fill(legend, h("div", { class: "muted" }, "Age of the image"), h("ul", {}, AGES.map(([label], age) => {
      const many = plan.points.byAge[age].length;
      return many > 0 && h("li", { class: `age-${age + 1}` }, `${label} (${count(many)})`);
    })));
    legend.hidden = !posed;
    fill(covered, cover ? facts(
      ["On the plan", plural(posed, "image")],
      ["Without pose", images.length - posed ? count(images.length - posed) : null],
      ["Extent", `${metres(cover.width)} × ${metres(cover.height)}`],
      ["Covered", `${plural(cover.cells, "square")} of 10 m`],
      ["Spacing", cover.spacing === null ? null : `${metres(cover.spacing)} (median)`],
      ["Newest", ago(new Date(cover.newest).toISOString())], ["Oldest", ago(new Date(cover.oldest).toISOString())],
    ) : h("p", { class: "muted" }, images.length ? "No image has a pose; the list contains all of them." : "There is no image yet."));
    listSoon();
  }

  async function load() {
    let cursor = null;
    do {
      const answer = await call(address(["maps", name, "images"], { limit: PAGE, cursor }), { signal });
      images.push(...answer.images);
      cursor = answer.next_cursor;
      // Redrawing costs time proportional to all images, so it is done after the first page and then every ten pages.
      if (!cursor || images.length === PAGE || images.length % (10 * PAGE) === 0) changed();
      progress.textContent = cursor ? `${count(images.length)} of ${plural(map.images, "image")} loaded…` : "";
    } while (cursor && images.length < MOST);
    if (cursor) progress.textContent = `The first ${count(images.length)} of ${plural(map.images, "image")} are shown.`;
    progress.hidden = !progress.textContent;
    if (!images.length) fill(progress, empty("No images yet", h("p", {}, "Add pictures with the form on this page, or from a folder:"), command(`whereabouts index FOLDER --map ${name}`)));
    progress.hidden = images.length > 0 && !cursor;
    const wanted = images.find((image) => image.id === query.get("image"));
    if (wanted) choose(wanted);
  }

  async function drawQuery() {
    const id = query.get("query");
    if (!id) return;
    asked.hidden = false;
    fill(asked, loading("the query"));
    try {
      const job = await call(address(["jobs", id]), { signal });
      const best = job.estimate?.image_id;
      const ranking = job.ranking ?? [];
      plan.setMarkers(ranking.map((candidate) => ({ pose: candidate.pose, label: String(candidate.rank), kind: candidate.image_id === best ? "estimate" : "candidate" })));
      const known = (image) => images.find((one) => one.id === image);
      fill(asked, h("div", { class: "heading" }, h("h2", {}, "Query"), h("a", { class: "heading-end", href: `#/jobs/${encodeURIComponent(id)}` }, "Its job")),
        job.estimate && h("p", {}, "Estimate ", h("code", {}, best), `, ${confidence(job.estimate.confidence)}${job.estimate.confidence == null ? "" : job.estimate.known ? ", known" : ", may not be in the map"}. It is ringed on the plan.`),
        ranking.length ? h("ol", { class: "images" }, ranking.map((candidate) => h("li", {}, h("button", { type: "button", onclick: () => { const image = known(candidate.image_id); if (image) choose(image, { focus: true }); } },
          h("span", {}, `${candidate.rank}. ${candidate.image_id}`), h("span", { class: "muted" }, candidate.pose ? "" : "no pose"))))) : h("p", { class: "muted" }, "The job has no ranking, so there are no candidates to show."));
    } catch (problem) {
      if (isAbort(problem)) return;
      fill(asked, h("p", {}, problem.status === 404 ? "This job is no longer stored." : problem.detail));
    }
  }

  drawQuery();
  changed();
  load().catch(fail);
}
