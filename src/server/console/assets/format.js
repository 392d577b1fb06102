// Formats numbers with units, times and names for people.

const number = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const compact = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

export const count = (value) => number.format(value);
export const short = (value) => (value < 10000 ? number.format(value) : compact.format(value).toLowerCase());
export const percent = (share) => `${Math.round(share * 100)} %`;

/** A confidence in words: null while it is not measured yet how convincing a wrong answer is in this map. */
export const confidence = (share) => share == null ? "confidence not measured yet" : `${downTo(share)} confidence`;

/** Rounded down, so that what is below a threshold is never shown as if it reached it. */
export const downTo = (share) => `${Math.floor(share * 100 + 1e-4)} %`;

/** What an estimate says about its place. */
export const knownOrNot = (estimate) => estimate.known ? "The place is known."
  : estimate.reason ?? (estimate.confidence == null
    ? "Whether the place is known is not measured yet: the images of the map were changed lately."
    : "May not be in the map: the confidence is below the configured threshold.");
export const plural = (value, one, many = `${one}s`) => `${count(value)} ${value === 1 ? one : many}`;

/** Formats a duration: "216 ms", "3.2 s", "4 min 10 s". */
export function duration(ms) {
  if (!Number.isFinite(ms)) return "–";
  if (ms < 1000) return `${ms < 10 ? Math.round(ms * 10) / 10 : Math.round(ms)} ms`;
  const s = ms / 1000;
  if (s < 60) return `${s.toFixed(1)} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${Math.floor(s % 60)} s`;
  return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

/** Formats the time since: "now", "40 s ago", "3 h ago", "12 days ago". */
export function ago(at, now = Date.now()) {
  const s = (now - Date.parse(at)) / 1000;
  if (!Number.isFinite(s)) return "–";
  if (s < 5) return "now";
  if (s < 60) return `${Math.floor(s)} s ago`;
  if (s < 3600) return `${Math.floor(s / 60)} min ago`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ago`;
  const days = Math.floor(s / 86400);
  if (days < 60) return days === 1 ? "1 day ago" : `${days} days ago`;
  return days < 730 ? `${Math.floor(days / 30.4)} months ago` : `${Math.floor(days / 365.25)} years ago`;
}

export const moment = (at) => (at ? new Date(at).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" }) : "–");

/** A relative time with the exact time as a tooltip; `refreshTimes` keeps it up to date. */
export function timeAgo(at) {
  if (!at) return "–";
  const made = document.createElement("time");
  made.dateTime = at;
  made.title = moment(at);
  made.textContent = ago(at);
  return made;
}

export function refreshTimes(root) {
  for (const made of root.querySelectorAll("time[datetime]")) {
    const text = ago(made.dateTime);
    if (made.textContent !== text) made.textContent = text;
  }
}

export function bytes(value) {
  if (value === null || value === undefined) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let at = 0;
  while (value >= 1000 && at < units.length - 1) { value /= 1000; at += 1; }
  return `${at === 0 || value >= 100 ? Math.round(value) : value.toFixed(1)} ${units[at]}`;
}

/** The end of a UUIDv7 distinguishes jobs; its start is the time. */
export const shortId = (id) => `…${id.slice(-8)}`;

export function metres(value) {
  if (value < 10) return `${value.toFixed(1)} m`;
  return value < 10000 ? `${count(value)} m` : `${(value / 1000).toFixed(1)} km`;
}

export function pose(value) {
  if (!value) return "no pose";
  if ("lat" in value) {
    const heading = value.heading === null || value.heading === undefined ? "" : `, facing ${Math.round(value.heading)}°`;
    return `${value.lat.toFixed(6)}, ${value.lon.toFixed(6)}${heading}`;
  }
  return `x ${value.x.toFixed(2)} m, y ${value.y.toFixed(2)} m`;
}

/** Formats the cost of a job or a pair. */
export function cost(usage) {
  if (!usage || (!usage.calls && !usage.cached)) return "no calls";
  const parts = [];
  if (usage.calls) parts.push(`${plural(usage.calls, "call")}, ${short(usage.prompt_tokens + usage.completion_tokens)} tokens`);
  if (usage.cached) parts.push(`${count(usage.cached)} cached`);
  return parts.join(", ");
}
