// Small charts of the last hour. Each also has its numbers as a table, for accessibility.

import { h, svg } from "./dom.js";

const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [560, 190, 50, 26, 10];
const MINUTE = 60e3;

/** Rounds up to a round number, for the top of a scale. */
function round(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1)));
  return [1, 2, 2.5, 5, 10].map((step) => step * power).find((top) => top >= value);
}

/**
 * `series`: `{name, of, kind: "line" | "bar", look}` per minute, where `of(minute)` is a number or null.
 */
export function chart({ title, unit, minutes, now, series, summary }) {
  const from = now - 60 * MINUTE;
  const values = series.flatMap(({ of }) => minutes.map(of)).filter((value) => value !== null && value !== undefined);
  const top = round(Math.max(1, ...values));
  const x = (at) => LEFT + ((at - from) / (60 * MINUTE)) * (WIDTH - LEFT - 6);
  const y = (value) => TOP + (1 - value / top) * (HEIGHT - TOP - BOTTOM);
  const lines = [0, 0.5, 1].map((share) => [
    svg("line", { class: "grid", x1: LEFT, x2: WIDTH - 6, y1: y(top * share), y2: y(top * share) }),
    svg("text", { x: LEFT - 6, y: y(top * share) + 4, "text-anchor": "end" }, String(top * share))]);
  const marks = [60, 45, 30, 15, 0].map((ago) => svg("text", { x: x(now - ago * MINUTE), y: HEIGHT - 5, "text-anchor": ago === 60 ? "start" : ago ? "middle" : "end" }, ago ? `−${ago} min` : "now"));
  const drawn = series.map(({ of, kind, look }) => {
    if (kind === "bar") {
      const width = (WIDTH - LEFT - 6) / 60;
      return minutes.filter((minute) => of(minute) > 0).map((minute) => {
        const at = x(Date.parse(minute.at));
        return svg("rect", { class: `bar ${look}`, x: Math.max(LEFT, at), width: width * 0.75, y: y(of(minute)), height: y(0) - y(of(minute)) });
      });
    }
    // A minute without a value, or without an entry, breaks the line.
    let path = "";
    let last = -Infinity;
    for (const minute of minutes) {
      const at = Date.parse(minute.at);
      const value = of(minute);
      if (value === null || value === undefined) continue;
      const here = `${x(Math.max(from, at)).toFixed(1)},${y(value).toFixed(1)}`;
      path += at - last <= 1.5 * MINUTE ? `L${here}` : `M${here}h.1`;
      last = at;
    }
    return svg("path", { class: `line ${look}`, d: path });
  });
  const clock = (at) => new Date(at).toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  const told = (value) => (value === null || value === undefined ? "–" : String(Math.round(value * 10) / 10));
  return h("section", { class: "card chart" }, h("h2", {}, `${title}, ${unit}`),
    h("div", { class: "keyline" }, series.map(({ name, look }) => h("span", { class: look }, name))),
    svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${title}: ${summary}` }, lines, marks, drawn),
    h("p", { class: "muted small" }, summary),
    h("details", {}, h("summary", {}, "As a table"), h("div", { class: "scroll settings", tabindex: "0", role: "region", "aria-label": `${title} by minute` }, h("table", {},
      h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Minute"), series.map(({ name }) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, [...minutes].reverse().map((minute) => h("tr", {}, h("th", { scope: "row" }, clock(minute.at)), series.map(({ of }) => h("td", {}, told(of(minute)))))))))));
}
