// A frame next to a candidate: both pictures, lines between their matched regions, and the description.

import { address, call, contentOf, frameOf, isAbort, picture } from "./api.js";
import { fill, h } from "./dom.js";
import { cost, count, duration, plural } from "./format.js";
import { readIn } from "./texts.js";
import { apart } from "./words.js";

const EDGE = 1024;
const FIRST = 150; // initial number of lines; all of them would hide the pictures

/** The two pictures of a pair. */
export function pictures(job, imageId, { signal }) {
  const lines = h("canvas", { class: "lines", "aria-hidden": "true" });
  const note = h("span", { class: "muted small" });
  const box = h("input", { type: "checkbox", id: "lines-on", checked: true });
  const many = h("input", { type: "range", id: "lines-many", min: "1", "aria-label": "Number of lines, strongest matches first" });
  const bar = h("div", { class: "pair-bar", hidden: true }, h("label", { class: "check", for: "lines-on" }, box, "Lines between matched regions"), many, note);
  let redraw = () => {};
  const options = { signal, loaded: () => redraw() };
  const frame = picture(frameOf(job.id, EDGE), "The frame", { ...options, gone: "The frame is no longer stored, or this server does not serve frames." });
  const image = picture(contentOf(job.map, imageId, EDGE), `Candidate ${imageId}`, { ...options, gone: "The image is no longer in the map." });
  const texts = h("div");
  const stage = h("div", { class: "pair" },
    h("figure", {}, frame, h("figcaption", {}, "Frame"), readIn(frame, job.texts)),
    h("figure", {}, image, h("figcaption", {}, "Candidate ", h("code", {}, imageId)), texts), lines);
  call(address(["maps", job.map, "images", imageId]), { signal }).then((state) => fill(texts, readIn(image, state.texts?.lines))).catch(() => {});
  const all = h("div", {}, stage, bar);
  if (job.refiner === "mllm") return all;

  call(address(["jobs", job.id, "matches", imageId]), { signal }).then((matches) => {
    bar.hidden = false;
    const all = matches.regions;
    if (!all.length) { box.parentElement.hidden = many.hidden = true; note.textContent = "No regions agree."; return; }
    many.max = String(all.length);
    many.value = String(Math.min(all.length, FIRST));
    many.hidden = all.length === 1;
    let near = -1;
    let regions = all;
    redraw = () => {
      regions = all.slice(0, Number(many.value));
      note.textContent = regions.length < all.length ? `${count(regions.length)} of ${plural(all.length, "region")}, the strongest` : plural(all.length, "region");
      draw(lines, stage, frame, image, regions, box.checked, near);
    };
    box.addEventListener("change", redraw);
    many.addEventListener("input", redraw);
    stage.addEventListener("pointermove", (event) => {
      const found = nearest(event, frame, image, regions);
      if (found !== near) { near = found; redraw(); }
    });
    stage.addEventListener("pointerleave", () => { near = -1; redraw(); });
    const observer = new ResizeObserver(redraw);
    observer.observe(stage);
    signal.addEventListener("abort", () => observer.disconnect());
    redraw();
  }).catch((problem) => {
    if (isAbort(problem)) return;
    bar.hidden = false;
    box.parentElement.hidden = many.hidden = true;
    note.textContent = problem.status === 404 ? "Matched regions cannot be shown: the frame or the image is gone, or this server does not provide them." : `Matched regions cannot be shown: ${problem.detail}`;
  });
  return all;
}

// Until it has loaded, a picture has the size of its alternative text.
const boxOf = (picture) => picture.classList.contains("here") && picture.querySelector("img").getBoundingClientRect();

function draw(canvas, stage, frame, image, regions, on, near) {
  const here = stage.getBoundingClientRect();
  const ratio = devicePixelRatio || 1;
  canvas.width = Math.round(here.width * ratio);
  canvas.height = Math.round(here.height * ratio);
  const ink = canvas.getContext("2d");
  const [a, b] = [boxOf(frame), boxOf(image)];
  if (!on || !a || !b) return;
  ink.scale(ratio, ratio);
  ink.translate(-here.left, -here.top);
  const many = regions.length;
  const line = (region, at) => {
    const [x0, y0] = place(region.frame, a);
    const [x1, y1] = place(region.image, b);
    // The hue depends on the place in the frame, so that regions that moved together have lines of similar colour.
    const hue = 20 + 300 * region.frame[1];
    ink.strokeStyle = ink.fillStyle = at === near ? "#fff" : `hsl(${hue} 90% 62% / ${many > 300 ? 0.3 : many > 100 ? 0.45 : 0.75})`;
    ink.lineWidth = at === near ? 3 : 1;
    ink.beginPath();
    ink.moveTo(x0, y0);
    ink.lineTo(x1, y1);
    ink.stroke();
    for (const [x, y] of [[x0, y0], [x1, y1]]) {
      ink.beginPath();
      ink.arc(x, y, at === near ? 5 : 2, 0, 2 * Math.PI);
      ink.fill();
    }
  };
  regions.forEach(line);
  if (near >= 0 && near < many) line(regions[near], near);
}

// Region coordinates are fractions of the width and the height.
const place = ([x, y], box) => [box.left + x * box.width, box.top + y * box.height];

function nearest(event, frame, image, regions) {
  let best = 14 ** 2;
  let found = -1;
  for (const [side, box] of [["frame", boxOf(frame)], ["image", boxOf(image)]]) {
    if (!box) continue;
    regions.forEach((region, at) => {
      const [x, y] = place(region[side], box);
      const far = (x - event.clientX) ** 2 + (y - event.clientY) ** 2;
      if (far < best) { best = far; found = at; }
    });
  }
  return found;
}

/** The description of a pair, with agreements and differences listed separately. */
export function words(description) {
  if (!description) return h("p", { class: "muted" }, "This pair has no description.");
  const found = apart(description.text);
  const list = (name, title, items) => h("section", { class: name }, h("h4", {}, title),
    items.length ? h("ul", {}, items.map((item) => h("li", {}, item))) : h("p", { class: "muted" }, "None listed."));
  const whole = (text) => text.split(/\n{2,}/).map((part) => h("p", { class: "told" }, part));
  return h("div", { class: "words" },
    found?.verdict && h("p", { class: "verdict" }, found.verdict),
    found && h("div", { class: "apart" }, list("agree", "Agrees", found.agree), list("differ", "Differs", found.differ)),
    found?.view && h("p", { class: "muted" }, found.view),
    found ? h("details", {}, h("summary", {}, "Full text"), whole(description.text)) : whole(description.text),
    h("p", { class: "muted small" }, bought(description), description.took_ms !== null && ` · took ${duration(description.took_ms)}`));
}

/** The source and cost of a description. */
export function bought(description) {
  if (description.stands_in) return `Reused from the similar frame of query ${description.stands_in.query_id} (similarity ${description.stands_in.similarity.toFixed(3)}).`;
  if (description.cached) return "Cached from an earlier job; no call was made.";
  return description.usage.calls ? cost(description.usage) : "Compared on this server; no call was made.";
}

/** The change of a candidate's rank, as text and symbol. */
export function moved(candidate) {
  const by = candidate.coarse_rank - candidate.rank;
  if (by === 0) return h("span", { class: "moved" }, "unchanged");
  return h("span", { class: by > 0 ? "moved up" : "moved down" }, by > 0 ? `▲ ${by}` : `▼ ${-by}`,
    h("span", { class: "unseen" }, by > 0 ? " places up" : " places down"));
}

export function fillPair(parent, job, imageId, description, options) {
  fill(parent, pictures(job, imageId, options), words(description));
}
