// Text that was read in a picture: a box around each line, over the picture, and the lines as a list.

import { h, svg } from "./dom.js";
import { plural } from "./format.js";

// Fractions of the width and height of the picture, whatever its size on the page.
const SIDE = 1000;

/** Draws boxes over a picture and returns a list of its lines; null if nothing was read. A line and its box light up
 * together. */
export function readIn(frame, lines) {
  frame.querySelector(".boxes")?.remove();
  if (!lines?.length) return null;
  const boxes = lines.map(({ text, corners }) => svg("polygon", { points: corners.map(([x, y]) => `${x * SIDE},${y * SIDE}`).join(" ") }, svg("title", {}, text)));
  const over = svg("svg", { class: "boxes", viewBox: `0 0 ${SIDE} ${SIDE}`, preserveAspectRatio: "none", "aria-hidden": "true" }, boxes);
  frame.append(over);
  const image = frame.querySelector("img");
  const fit = () => { if (image.naturalWidth) over.style.aspectRatio = `${image.naturalWidth} / ${image.naturalHeight}`; };
  image?.addEventListener("load", fit);
  if (image) fit();
  const items = lines.map(({ text, confidence }) => h("li", {}, h("span", { class: "tag" }, text), h("span", { class: "muted small" }, ` ${Math.round(100 * confidence)} %`)));
  items.forEach((item, at) => {
    for (const [part, other] of [[item, boxes[at]], [boxes[at], item]]) {
      part.addEventListener("pointerenter", () => other.classList.add("lit"));
      part.addEventListener("pointerleave", () => other.classList.remove("lit"));
    }
  });
  return h("details", { class: "read", open: lines.length <= 12 }, h("summary", {}, `Text: ${plural(lines.length, "line")}`), h("ul", {}, items));
}
