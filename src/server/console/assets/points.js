// The images of a map as points on a plane, in metres: typed arrays, a grid for neighbour search, and statistics of
// coverage and age. Nothing here draws.

const ROUND = 40075016.686; // metres around the equator
const DAY = 86400e3;

export const AGES = [["up to a week", 7], ["a month", 31], ["3 months", 92], ["a year", 366], ["older", Infinity]];

/** Projects a point to the Web Mercator square, 0 to 1. */
export function mercator(lat, lon) {
  const sine = Math.min(0.9999, Math.max(-0.9999, Math.sin((lat * Math.PI) / 180)));
  return [lon / 360 + 0.5, 0.5 - Math.log((1 + sine) / (1 - sine)) / (4 * Math.PI)];
}

/** A projection plane: Mercator scaled to true metres at `first`, or the map's own metres. */
export function plane(first) {
  if (!first || !("lat" in first)) return { project: (pose) => [pose.x, pose.y], unproject: (x, y) => ({ x, y }), geographic: false };
  const [mx, my] = mercator(first.lat, first.lon);
  const span = ROUND * Math.cos((first.lat * Math.PI) / 180);
  return {
    geographic: true, mx, my, span,
    project(pose) {
      const [x, y] = mercator(pose.lat, pose.lon);
      // Keeps a map across the antimeridian in one piece.
      return [span * (((x - mx + 1.5) % 1) - 0.5), span * (my - y)];
    },
    unproject(x, y) {
      const lon = ((x / span + mx) * 360) % 360 - 180;
      return { lat: (Math.atan(Math.sinh(Math.PI * (1 - 2 * (my - y / span)))) * 180) / Math.PI, lon: lon < -180 ? lon + 360 : lon };
    },
  };
}

/** The viewing direction of a camera on the plan, in radians clockwise from up; NaN if unknown. */
function bearing(pose) {
  if (pose.heading !== null && pose.heading !== undefined) return (pose.heading * Math.PI) / 180;
  const { qx, qy, qz, qw } = pose;
  if (qw === null || qw === undefined) return NaN;
  // The body's x axis points forward (REP 103).
  return Math.PI / 2 - Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));
}

export const takenAt = (image) => image.captured_at ?? image.created_at;

/** The points of the images that have a pose. */
export class Points {
  constructor(images, plane) {
    this.images = images.filter((image) => image.pose);
    this.plane = plane;
    const many = this.images.length;
    this.x = new Float64Array(many);
    this.y = new Float64Array(many);
    this.bearing = new Float32Array(many);
    this.age = new Uint8Array(many);
    this.box = [Infinity, Infinity, -Infinity, -Infinity];
    const now = Date.now();
    this.images.forEach((image, at) => {
      const [x, y] = plane.project(image.pose);
      this.x[at] = x;
      this.y[at] = y;
      this.bearing[at] = bearing(image.pose);
      const days = (now - Date.parse(takenAt(image))) / DAY;
      this.age[at] = AGES.findIndex(([, limit]) => days <= limit);
      this.box = [Math.min(this.box[0], x), Math.min(this.box[1], y), Math.max(this.box[2], x), Math.max(this.box[3], y)];
    });
    this.grid();
    this.byAge = AGES.map((_, age) => Int32Array.from([...this.age.keys()].filter((at) => this.age[at] === age)));
  }

  get length() { return this.x.length; }

  /** Sorts the points into grid cells, about four per cell. */
  grid() {
    const [x0, y0, x1, y1] = this.length ? this.box : [0, 0, 0, 0];
    const [width, height] = [Math.max(x1 - x0, 1e-6), Math.max(y1 - y0, 1e-6)];
    this.cell = Math.max(Math.sqrt((width * height * 4) / Math.max(1, this.length)), Math.max(width, height) / 512, 1e-6);
    this.columns = Math.floor(width / this.cell) + 1;
    this.lines = Math.floor(height / this.cell) + 1;
    this.start = new Int32Array(this.columns * this.lines + 1);
    this.order = new Int32Array(this.length);
    const cells = new Int32Array(this.length);
    for (let at = 0; at < this.length; at += 1) {
      cells[at] = Math.floor((this.y[at] - y0) / this.cell) * this.columns + Math.floor((this.x[at] - x0) / this.cell);
      this.start[cells[at] + 1] += 1;
    }
    for (let at = 1; at < this.start.length; at += 1) this.start[at] += this.start[at - 1];
    const next = this.start.slice();
    for (let at = 0; at < this.length; at += 1) this.order[next[cells[at]]++] = at;
  }

  /** Calls `visit` for each point in the cells that intersect a box. */
  within(x0, y0, x1, y1, visit) {
    if (!this.length) return;
    const clamp = (value, most) => Math.min(most, Math.max(0, Math.floor(value)));
    const [left, right] = [x0, x1].map((x) => clamp((x - this.box[0]) / this.cell, this.columns - 1));
    const [low, high] = [y0, y1].map((y) => clamp((y - this.box[1]) / this.cell, this.lines - 1));
    for (let line = low; line <= high; line += 1) {
      const from = this.start[line * this.columns + left];
      const to = this.start[line * this.columns + right + 1];
      for (let at = from; at < to; at += 1) visit(this.order[at]);
    }
  }

  /** The index of the nearest point within `reach`; −1 if there is none. */
  nearest(x, y, reach, except = -1) {
    let found = -1;
    let best = reach * reach;
    this.within(x - reach, y - reach, x + reach, y + reach, (at) => {
      const far = (this.x[at] - x) ** 2 + (this.y[at] - y) ** 2;
      if (far <= best && at !== except) { best = far; found = at; }
    });
    return found;
  }

  /** Statistics of extent, spacing and age. */
  coverage() {
    if (!this.length) return null;
    const [x0, y0, x1, y1] = this.box;
    const cells = new Set();
    for (let at = 0; at < this.length; at += 1) cells.add(`${Math.floor(this.x[at] / 10)},${Math.floor(this.y[at] / 10)}`);
    // The spacing of a sample is accurate enough, and fast for a large map.
    const gaps = [];
    for (let at = 0; at < this.length; at += Math.max(1, Math.floor(this.length / 1000))) {
      let reach = this.cell;
      let near = -1;
      for (let tries = 0; near < 0 && tries < 12; tries += 1, reach *= 2) near = this.nearest(this.x[at], this.y[at], reach, at);
      if (near >= 0) gaps.push(Math.hypot(this.x[near] - this.x[at], this.y[near] - this.y[at]));
    }
    gaps.sort((a, b) => a - b);
    const times = this.images.map((image) => Date.parse(takenAt(image))).filter(Number.isFinite);
    return {
      width: x1 - x0, height: y1 - y0, cells: cells.size, spacing: gaps[gaps.length >> 1] ?? null,
      oldest: times.reduce((a, b) => Math.min(a, b), Infinity), newest: times.reduce((a, b) => Math.max(a, b), -Infinity),
    };
  }
}
