// One image of a map: its picture and metadata, correcting and deleting it, and adding another.

import { address, call, contentOf, isAbort, picture } from "./api.js";
import { announce, confirm, facts, failure, fill, h } from "./dom.js";
import { ago, moment, pose } from "./format.js";
import { readIn } from "./texts.js";

export function imageCard(map, image, { signal, removed, close, corrected }) {
  const said = h("div");
  const remove = async () => {
    const sure = await confirm({ title: "Delete this image?", text: `${image.id} will be removed from the map ${map.name}. Jobs that compared it keep their texts.`, action: "Delete the image" });
    if (!sure) return;
    try {
      await call(address(["maps", map.name, "images", image.id]), { method: "DELETE", signal });
      announce("The image is deleted.");
      removed();
    } catch (problem) { if (!isAbort(problem)) fill(said, failure(problem)); }
  };
  const shown = picture(contentOf(map.name, image.id, 800), `The image ${image.id}`, { signal, gone: "The picture is gone." });
  const texts = h("div");
  // The list of images has no texts.
  call(address(["maps", map.name, "images", image.id]), { signal })
    .then((state) => fill(texts, readIn(shown, state.texts?.lines), state.texts?.error && h("p", { class: "muted small" }, `Its text cannot be read: ${state.texts.error}`)))
    .catch(() => {});
  const time = (at) => at && h("span", {}, ago(at), h("span", { class: "muted small" }, ` · ${moment(at)}`));
  return [
    h("div", { class: "heading" }, h("h2", { class: "wrap" }, image.id), h("button", { type: "button", class: "quiet heading-end", onclick: close }, "Close")),
    shown, texts,
    facts(["Pose", pose(image.pose)], ["Taken", time(image.captured_at)], ["Stored", time(image.created_at)],
      ["Size", `${image.width} × ${image.height} pixels`],
      ["Tags", image.tags?.length ? h("span", { class: "tags" }, image.tags.map((tag) => h("span", { class: "tag" }, tag))) : null]),
    said, correction(map, image, { signal, corrected }),
    h("button", { type: "button", class: "danger", onclick: remove }, "Delete the image…"),
  ];
}

const POSE = {
  wgs84: [["lat", "Latitude, degrees"], ["lon", "Longitude, degrees"], ["alt", "Height, metres"], ["heading", "Heading, degrees"]],
  metric: [["x", "x, metres"], ["y", "y, metres"], ["z", "z, metres"]],
};

// A merge patch: a number that is emptied is removed, and so is the pose once all are. An orientation that the form
// does not show stays.
function correction(map, image, { signal, corrected }) {
  const fields = POSE[map.frame] ?? [];
  const said = h("div", { role: "status" });
  const input = (name, label, value, attributes = {}) =>
    h("label", { for: `edit-${name}` }, label, h("input", { type: "text", id: `edit-${name}`, name, autocomplete: "off", value: value ?? "", ...attributes }));
  const save = h("button", { type: "submit", class: "primary" }, "Save");
  const form = h("form", {},
    h("div", { class: "grid-2" }, fields.map(([name, label]) => input(name, label, image.pose?.[name], { type: "number", step: "any", inputmode: "decimal" }))),
    input("captured_at", "Taken", image.captured_at, { placeholder: "2026-05-01T12:00:00Z" }),
    input("tags", "Tags, separated by commas", image.tags?.join(", ")),
    h("div", { class: "actions" }, save), said);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const typed = (name) => form.elements[name].value.trim();
    const numbers = fields.map(([name]) => [name, typed(name) === "" ? null : Number(typed(name))]);
    const pose = numbers.every(([, value]) => value === null) ? null : Object.fromEntries(numbers);
    const tags = typed("tags").split(",").map((tag) => tag.trim()).filter(Boolean);
    save.disabled = true;
    try {
      const changed = await call(address(["maps", map.name, "images", image.id]), { method: "PATCH", json: { pose, captured_at: typed("captured_at") || null, tags }, signal });
      announce(changed.changed.length ? "The image is changed." : "Nothing to change.");
      corrected(changed);
    } catch (problem) { if (!isAbort(problem)) fill(said, failure(problem)); }
    save.disabled = false;
  });
  return h("details", {}, h("summary", {}, "Correct the pose, time or tags"), form);
}

export function uploadCard(map, { signal, added, centre }) {
  const field = (name, label, attributes = {}) => {
    const input = h("input", { type: "text", id: `up-${name}`, name, autocomplete: "off", ...attributes });
    return h("label", { for: `up-${name}` }, label, input);
  };
  const number = { type: "number", step: "any", inputmode: "decimal" };
  const geographic = map.frame === "wgs84";
  const said = h("div", { role: "status" });
  const send = h("button", { type: "submit", class: "primary" }, "Add the image");
  const form = h("form", {},
    h("label", { for: "up-file" }, "Picture (JPEG, PNG, WebP, TIFF, BMP, GIF or PNM)", h("input", { type: "file", id: "up-file", accept: "image/*,.pgm,.ppm,.pbm,.pnm,.pam", required: true })),
    h("div", { class: "grid-2" },
      geographic ? [field("lat", "Latitude, degrees", { ...number, min: "-90", max: "90" }), field("lon", "Longitude, degrees", { ...number, min: "-180", max: "180" }), field("heading", "Heading, degrees", { ...number, min: "0", max: "360" })]
        : [field("x", "x, metres", number), field("y", "y, metres", number)],
      field("id", "Id", { placeholder: "from the picture" })),
    field("tags", "Tags, separated by commas"),
    h("div", { class: "actions" }, send, h("button", { type: "button", onclick: () => {
      const middle = centre();
      if (!middle) { said.textContent = "The plan is empty, so it has no centre yet."; return; }
      for (const [name, value] of Object.entries(middle)) form.elements[name].value = value.toFixed(geographic ? 7 : 3);
    } }, "Use the centre of the plan as the pose")), said);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const [file] = form.elements["up-file"].files;
    const query = {};
    for (const name of ["lat", "lon", "heading", "x", "y", "id", "tags"]) if (form.elements[name]) query[name] = form.elements[name].value.trim();
    send.disabled = true;
    said.textContent = "Sending…";
    try {
      const image = await call(address(["maps", map.name, "images"], query), { method: "POST", body: file, headers: { "Content-Type": file.type || "application/octet-stream" }, signal });
      said.textContent = [`Added as ${image.id}.`, ...(image.warnings ?? []).map((warning) => `Warning: ${warning}.`)].join(" ");
      form.reset();
      added(image);
    } catch (problem) { if (!isAbort(problem)) fill(said, failure(problem)); }
    send.disabled = false;
  });
  return h("section", { class: "card" }, h("h2", {}, "Add an image"), h("details", {}, h("summary", {}, "Upload a picture"), form,
    h("p", { class: "muted small" }, "An image without a pose can be found but gives no place. For a whole folder: "), h("code", { class: "small" }, `whereabouts index FOLDER --map ${map.name}`)));
}
