// DOM helpers without markup: everything from the server, including names, tags and model text, enters the page
// only as text nodes and attributes. Nothing in this folder sets innerHTML.

import { downTo } from "./format.js";

/** Creates an element. `attributes`: `class`, `on…` handlers, booleans or plain attributes; null is skipped. */
export function h(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "value") made.value = value;
    else made.setAttribute(key, value === true ? "" : value);
  }
  add(made, ...children);
  return made;
}

/** Creates an SVG element. */
export function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  add(made, ...children);
  return made;
}

function add(parent, ...children) {
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined && child !== false) parent.append(child);
  }
}

/** Replaces the children of an element. */
export function fill(parent, ...children) {
  parent.replaceChildren();
  add(parent, ...children);
  return parent;
}

/** A definition list; entries without a value are skipped. */
export function facts(...pairs) {
  const given = pairs.filter(([, value]) => value !== null && value !== undefined && value !== "");
  return h("dl", { class: "facts" }, given.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))));
}

/** A state as a coloured badge. */
export function badge(state) {
  return h("span", { class: `badge ${/^[a-z]+$/.test(state) ? state : ""}` }, state);
}

/** An error message, with an optional retry button. */
export function failure(problem, again) {
  return h("div", { class: "notice bad", role: "alert" },
    h("strong", {}, problem.title ?? "Something went wrong"),
    h("p", {}, problem.detail ?? String(problem)),
    problem.requestId && h("p", { class: "muted small" }, "Request ", h("code", {}, problem.requestId)),
    again && h("button", { type: "button", onclick: again }, "Try again"));
}

/** An empty state, with advice on what to do. */
export function empty(title, ...advice) {
  return h("div", { class: "empty" }, h("h2", {}, title), advice);
}

/** A command for a terminal. */
export function command(text) {
  return h("pre", { class: "command", tabindex: "0" }, h("code", {}, text));
}

export function loading(what) {
  return h("p", { class: "muted loading" }, `Loading ${what}…`);
}

/** A meter of a value against its limit. */
export function meter(value, limit, label) {
  value ??= 0;
  const share = limit ? Math.min(1, value / limit) : 0;
  const bar = h("div", { class: share > 0.8 ? "meter high" : "meter", role: "meter", "aria-label": label,
    "aria-valuemin": "0", "aria-valuemax": String(limit || 1), "aria-valuenow": String(value) }, h("div"));
  bar.firstChild.style.width = `${share * 100}%`;
  return bar;
}

let announcing;
/** Announces a text to screen readers, at most twice a second; the latest text wins. */
export function announce(text) {
  clearTimeout(announcing);
  announcing = setTimeout(() => { document.getElementById("live").textContent = text; }, 500);
}

/** Asks for confirmation of an irreversible action. If `word` is given, it must be typed. */
export function confirm({ title, text, action, word }) {
  return new Promise((resolve) => {
    const typed = word && h("input", { type: "text", autocomplete: "off", spellcheck: "false" });
    const form = h("form", { method: "dialog" },
      h("h2", { id: "confirm-title" }, title),
      h("p", {}, text),
      word && h("label", {}, "Type ", h("code", {}, word), " to confirm", typed),
      h("div", { class: "actions" },
        h("button", { type: "button", onclick: () => close(false) }, "Keep"),
        h("button", { type: "submit", class: "danger" }, action)));
    const dialog = h("dialog", { "aria-labelledby": "confirm-title" }, form);
    const close = (answer) => { dialog.close(); dialog.remove(); resolve(answer); };
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      if (!word || typed.value === word) close(true);
      else typed.focus();
    });
    dialog.addEventListener("cancel", () => close(false));
    document.body.append(dialog);
    dialog.showModal();
  });
}

/** The confidence of an estimate as a large number, or that it is not measured yet. */
export function confidenceLine(estimate) {
  return estimate.confidence == null ? h("p", { class: "muted" }, "Confidence not measured yet")
    : h("p", { class: "big" }, downTo(estimate.confidence), h("span", { class: "muted" }, " confidence"));
}
