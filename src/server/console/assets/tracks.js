// The robots in a map: a card that lists their tracks, and draws the way of the chosen one on the plan.

import { address, call, isAbort } from "./api.js";
import { fill, h } from "./dom.js";
import { ago, percent, plural, pose } from "./format.js";

const PAUSE = 3000; // milliseconds between two looks

/** The card of the tracks in the map `name`; hidden while there are none. `query` and `setQuery` keep the choice. */
export function tracksCard(name, { plan, signal, query, setQuery }) {
  let chosen = query.get("track");
  let known = [];
  const list = h("ul", { class: "images" });
  const way = h("div", { role: "status" });
  const card = h("section", { class: "card", "aria-label": "Robots", hidden: true }, h("h2", {}, "Robots"),
    h("p", { class: "muted small" }, "Choose a track to see its way on the plan: each place follows from the frames before and after it."), list, way);

  function choose(id) {
    chosen = chosen === id ? null : id;
    setQuery({ track: chosen });
    drawList();
    look();
  }

  function drawList() {
    fill(list, known.map((track) => h("li", {}, h("button", { type: "button", "aria-pressed": String(track.id === chosen), onclick: () => choose(track.id) },
      h("span", {}, track.id), h("span", { class: "muted" }, `${plural(track.frames, "frame")}, ${ago(track.last_frame_at)}`)))));
  }

  function drawWay({ places }) {
    plan.setWay(places);
    const last = places.at(-1);
    const sure = places.filter((place) => place.known).length;
    fill(way, last && h("p", {}, last.off_map > 0.5 ? `Probably off the map (${percent(last.off_map)})` : ["At ", h("code", {}, last.image_id ?? "no image"), `, ${percent(last.probability)}${last.known ? "" : ", not sure"}`],
      h("br"), h("span", { class: "muted small" }, `${pose(last.pose)}; ${plural(places.length, "place")}, ${sure} of them sure`)));
  }

  async function look() {
    clearTimeout(timer);
    try {
      const { tracks } = await call(address(["maps", name, "tracks"]), { signal });
      if (JSON.stringify(tracks) !== JSON.stringify(known)) {
        known = tracks;
        drawList();
      }
      card.hidden = !known.length;
      if (chosen) drawWay(await call(address(["maps", name, "tracks", chosen]), { signal }));
      else { plan.setWay([]); fill(way); }
    } catch (problem) {
      if (isAbort(problem)) return;
      plan.setWay([]);
      fill(way, chosen && h("p", {}, problem.status === 404 ? "This track has ended." : problem.detail));
    }
    if (!signal.aborted) timer = setTimeout(look, PAUSE);
  }

  let timer = 0;
  signal.addEventListener("abort", () => clearTimeout(timer));
  look();
  return card;
}
