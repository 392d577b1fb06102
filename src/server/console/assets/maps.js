// The list of maps, and how to create the first one.

import { call } from "./api.js";
import { command, empty, facts, fill, h, loading } from "./dom.js";
import { count, percent, timeAgo } from "./format.js";

export async function show({ root, signal, title }) {
  title("Maps");
  fill(root, h("h1", {}, "Maps"), loading("the maps"));
  const { maps } = await call("maps", { signal });
  if (!maps.length) {
    fill(root, h("h1", {}, "Maps"), empty("No map yet",
      h("p", {}, "A map is built from a folder of pictures with known poses, from EXIF or a table:"),
      command("whereabouts index FOLDER --map NAME"),
      h("p", {}, "To try it first, create a small demo town:"), command("whereabouts demo --offline")));
    return;
  }
  fill(root, h("h1", {}, "Maps"), h("ul", { class: "cards" }, maps.map((map) => h("li", { class: "card" },
    h("h2", {}, h("a", { href: `#/maps/${encodeURIComponent(map.name)}` }, map.name)),
    map.description && h("p", {}, map.description),
    facts(["Images", map.images ? count(map.images) : "none yet"], ["Scene", map.scene], ["Poses", map.frame],
      ["Model", `${map.model}, ${map.descriptor}`], ["Search", searched(map)], ["Reindex", reindexed(map)], ["Created", timeAgo(map.created_at)]),
    h("p", { class: "actions" }, h("a", { href: `#/try?map=${encodeURIComponent(map.name)}` }, "Try a picture"),
      h("a", { href: `#/jobs?map=${encodeURIComponent(map.name)}` }, "Its jobs"))))));
}

export const searched = (map) => ({ exact: "exact", building: "exact; a graph is being built", hnsw: "HNSW graph" })[map.index] ?? map.index;

export function reindexed({ reindex }) {
  if (!reindex) return null;
  if (reindex.state === "running") return `${percent(reindex.done / Math.max(1, reindex.total))} done, with ${reindex.model}`;
  return reindex.error ? `failed: ${reindex.error}` : reindex.state;
}
