// The plan: a canvas with the points of a map, panned and zoomed by mouse, touch and keyboard. It redraws only after
// a change, at most once per animation frame.

import { metres } from "./format.js";
import { Points, plane } from "./points.js";

const REACH = 14; // hit radius of a point, in pixels
const PLACE_M = 10; // radius covered by an image in the coverage overlay

export class Plan {
  /** Calls `picked(image)` on a click and `moved()` after a redraw; `tiles` is a URL template or null. */
  constructor(canvas, { signal, picked, moved, tiles = null }) {
    Object.assign(this, { canvas, picked, moved, tiles });
    this.ink = canvas.getContext("2d");
    this.points = new Points([], plane(null));
    this.plane = null;
    this.markers = [];
    this.way = [];
    this.chosen = null;
    this.coverage = false;
    this.centre = [0, 0];
    this.scale = 1; // pixels per metre
    this.size = [1, 1];
    this.fitted = true;
    this.loaded = new Map();
    this.pointers = new Map();
    this.listen(signal);
    this.paint();
  }

  /** The first pose determines the projection plane. */
  around(pose) { if (pose) this.plane ??= plane(pose); }

  setImages(images) {
    this.around(images.find((image) => image.pose)?.pose);
    this.points = new Points(images, this.plane ?? plane(null));
    if (this.fitted) this.fit();
    this.touch();
  }

  /** Sets numbered markers: `{pose, label, kind}` of kind "candidate" or "estimate". */
  setMarkers(markers) {
    this.around(markers.find((marker) => marker.pose)?.pose);
    this.markers = markers.filter((marker) => marker.pose).map((marker) => ({ ...marker, at: this.plane.project(marker.pose) }));
    if (this.fitted) this.fit();
    this.touch();
  }

  /** Sets the way of a robot: places with `pose`, `known` and `off_map`, the oldest first. */
  setWay(places) {
    this.around(places.find((place) => place.pose)?.pose);
    this.way = places.filter((place) => place.pose).map((place) => ({ ...place, at: this.plane.project(place.pose) }));
    this.touch();
  }

  choose(image) { this.chosen = image; this.touch(); }

  /** Fits all points into view, or all markers if there are any. */
  fit(everything = false) {
    this.fitted = true;
    let box = this.points.length ? this.points.box : null;
    if (this.markers.length && !(everything && box)) {
      box = this.markers.reduce(([a, b, c, d], { at: [x, y] }) => [Math.min(a, x), Math.min(b, y), Math.max(c, x), Math.max(d, y)], [Infinity, Infinity, -Infinity, -Infinity]);
    }
    if (!box) return;
    const [x0, y0, x1, y1] = box;
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
    const [w, h] = this.size;
    this.scale = Math.min(Math.max(20, w - 90) / Math.max(x1 - x0, 8), Math.max(20, h - 110) / Math.max(y1 - y0, 8));
    this.touch();
  }

  /** Zooms around a point; by default around the chosen image, if visible, else the centre. */
  zoom(by, at = this.middle()) {
    const before = this.toWorld(...at);
    this.scale = Math.min(400, Math.max(1e-5, this.scale * by));
    const after = this.toWorld(...at);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    this.fitted = false;
    this.touch();
  }

  middle() {
    const [w, h] = this.size;
    const [x, y] = this.chosen?.pose ? this.toScreen(...this.plane.project(this.chosen.pose)) : [-1, -1];
    return x > 0 && y > 0 && x < w && y < h ? [x, y] : [w / 2, h / 2];
  }

  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.fitted = false;
    this.touch();
  }

  goTo(pose) {
    const [x, y] = this.plane.project(pose);
    const [sx, sy] = this.toScreen(x, y);
    if (sx > 30 && sy > 30 && sx < this.size[0] - 30 && sy < this.size[1] - 30) return;
    this.centre = [x, y];
    this.fitted = false;
    this.touch();
  }

  poseOfCentre() { return this.plane?.unproject(...this.centre) ?? null; }

  /** The images in view. */
  inView() {
    const seen = [];
    const [x0, y0, x1, y1] = this.bounds();
    this.points.within(x0, y0, x1, y1, (at) => {
      const [x, y] = [this.points.x[at], this.points.y[at]];
      if (x >= x0 && x <= x1 && y >= y0 && y <= y1) seen.push(this.points.images[at]);
    });
    return seen;
  }

  toWorld(x, y) { return [this.centre[0] + (x - this.size[0] / 2) / this.scale, this.centre[1] - (y - this.size[1] / 2) / this.scale]; }
  toScreen(x, y) { return [(x - this.centre[0]) * this.scale + this.size[0] / 2, this.size[1] / 2 - (y - this.centre[1]) * this.scale]; }
  bounds() { const [x0, y1] = this.toWorld(0, 0); const [x1, y0] = this.toWorld(...this.size); return [x0, y0, x1, y1]; }

  touch() {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => { this.frame = 0; this.draw(); this.moved?.(); });
  }

  // Input

  listen(signal) {
    const { canvas } = this;
    const on = (name, handle, options = {}) => canvas.addEventListener(name, handle, { ...options, signal });
    const where = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    let dragged = 0;
    on("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      if (!this.pointers.size) dragged = 0;
      this.pointers.set(event.pointerId, where(event));
    });
    on("pointermove", (event) => {
      const last = this.pointers.get(event.pointerId);
      if (!last) return;
      const here = where(event);
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
      if (other) {
        const [was, is] = [last, here].map(([x, y]) => Math.hypot(x - other[0], y - other[1]));
        if (was > 0) this.zoom(is / was, [(here[0] + other[0]) / 2, (here[1] + other[1]) / 2]);
        this.pan((here[0] - last[0]) / 2, (here[1] - last[1]) / 2);
      } else if (dragged > 4) {
        this.pan(here[0] - last[0], here[1] - last[1]);
      } else {
        // A shaky click is not a drag.
        dragged += Math.hypot(here[0] - last[0], here[1] - last[1]);
      }
      this.pointers.set(event.pointerId, here);
    });
    const up = (event) => {
      const last = this.pointers.get(event.pointerId);
      this.pointers.delete(event.pointerId);
      if (event.type === "pointerup" && last && dragged <= 4 && !this.pointers.size) {
        const at = this.points.nearest(...this.toWorld(...last), REACH / this.scale);
        if (at >= 0) this.picked(this.points.images[at]);
      }
    };
    on("pointerup", up);
    on("pointercancel", up);
    on("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 18 : 1;
      this.zoom(Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0018)), where(event));
    }, { passive: false });
    on("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = 60;
      const keys = {
        ArrowLeft: () => this.pan(step, 0), ArrowRight: () => this.pan(-step, 0), ArrowUp: () => this.pan(0, step), ArrowDown: () => this.pan(0, -step),
        "+": () => this.zoom(1.4), "=": () => this.zoom(1.4), "-": () => this.zoom(1 / 1.4), 0: () => this.fit(true),
      };
      if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
    });
    const observer = new ResizeObserver(() => {
      const { width, height } = canvas.getBoundingClientRect();
      const ratio = devicePixelRatio || 1;
      this.size = [width, height];
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
      if (this.fitted) this.fit();
      this.touch();
    });
    observer.observe(canvas);
    addEventListener("themechange", () => this.paint(), { signal });
    signal.addEventListener("abort", () => { observer.disconnect(); cancelAnimationFrame(this.frame); this.frame = 1; });
  }

  // Drawing

  /** Reads the colours from the stylesheet, because a canvas cannot use `var()`. */
  paint() {
    const probe = document.createElement("span");
    this.canvas.parentElement.append(probe);
    this.colours = Object.fromEntries(["card", "ink", "muted", "line", "accent", "good", "bad", "age-1", "age-2", "age-3", "age-4", "age-5"].map((name) => {
      probe.style.color = `var(--${name})`;
      return [name, getComputedStyle(probe).color];
    }));
    probe.remove();
    this.dark = Number(this.colours.card.match(/\d+/)) < 128;
    this.touch();
  }

  draw() {
    const { ink, colours, size: [w, h] } = this;
    const ratio = this.canvas.width / w;
    ink.setTransform(ratio, 0, 0, ratio, 0, 0);
    ink.clearRect(0, 0, w, h);
    if (this.tiles && this.plane?.geographic) this.drawTiles();
    else this.drawLines();
    if (this.coverage) this.drawDiscs();
    this.drawPoints();
    this.drawWay();
    this.drawMarkers();
    this.drawScale(colours);
  }

  /** Draws points as copies of one dot, or as squares when zoomed out. A path of thousands of arcs is ten times slower. */
  drawPoints() {
    const { ink, points, scale, size: [w, h], centre: [cx, cy] } = this;
    const near = scale > 2.2;
    // Few points are drawn larger; many large ones would hide each other.
    const least = points.length < 500 ? 3.6 : points.length < 5000 ? 2.4 : 1.6;
    const radius = Math.min(6, Math.max(least, 2.2 + Math.log2(scale + 0.2)));
    const edge = Math.round(2 * radius);
    points.byAge.forEach((list, age) => {
      ink.fillStyle = ink.strokeStyle = this.colours[`age-${age + 1}`];
      const dot = radius < 3 ? null : this.dot(radius, age);
      for (let i = 0; i < list.length; i += 1) {
        const at = list[i];
        const x = (points.x[at] - cx) * scale + w / 2;
        const y = h / 2 - (points.y[at] - cy) * scale;
        if (x < -20 || y < -20 || x > w + 20 || y > h + 20) continue;
        if (dot) ink.drawImage(dot, x - radius - 1, y - radius - 1, dot.size, dot.size);
        else ink.fillRect(Math.round(x - radius), Math.round(y - radius), edge, edge);
      }
      if (!near) return;
      ink.lineWidth = 2;
      ink.beginPath();
      for (let i = 0; i < list.length; i += 1) {
        const at = list[i];
        const turn = points.bearing[at];
        if (turn !== turn) continue; // NaN: unknown
        const x = (points.x[at] - cx) * scale + w / 2;
        const y = h / 2 - (points.y[at] - cy) * scale;
        if (x < -20 || y < -20 || x > w + 20 || y > h + 20) continue;
        ink.moveTo(x, y);
        ink.lineTo(x + Math.sin(turn) * (radius + 13), y - Math.cos(turn) * (radius + 13));
      }
      ink.stroke();
    });
  }

  /** A dot image, cached by size and colour. */
  dot(radius, age) {
    const ratio = this.canvas.width / this.size[0];
    const name = `${radius} ${ratio} ${this.colours[`age-${age + 1}`]}`;
    if (this.dots?.[age]?.name !== name) {
      const size = Math.ceil(2 * radius + 2);
      const made = Object.assign(document.createElement("canvas"), { width: size * ratio, height: size * ratio, name, size });
      const ink = made.getContext("2d");
      ink.scale(ratio, ratio);
      ink.fillStyle = this.colours[`age-${age + 1}`];
      ink.arc(radius + 1, radius + 1, radius, 0, 6.2832);
      ink.fill();
      (this.dots ??= [])[age] = made;
    }
    return this.dots[age];
  }

  drawDiscs() {
    const { ink, points } = this;
    const radius = PLACE_M * this.scale;
    ink.fillStyle = this.colours.good;
    ink.globalAlpha = 0.2;
    ink.beginPath();
    for (let at = 0; at < points.length; at += 1) {
      const [x, y] = this.toScreen(points.x[at], points.y[at]);
      if (x < -radius || y < -radius || x > this.size[0] + radius || y > this.size[1] + radius) continue;
      ink.moveTo(x + radius, y);
      ink.arc(x, y, radius, 0, 6.2832);
    }
    ink.fill(); // one path, so that overlapping discs do not accumulate opacity
    ink.globalAlpha = 1;
  }

  /** Draws a way: solid where the robot's place is sure, with a gap where it may be anywhere or off the map. */
  drawWay() {
    const { ink, colours, way } = this;
    const isLost = (place) => place.off_map > 0.5 || place.probability < 0.2;
    ink.strokeStyle = ink.fillStyle = colours.good;
    ink.lineWidth = 4;
    ink.lineJoin = ink.lineCap = "round";
    for (let at = 1; at < way.length; at += 1) {
      const [before, here] = [way[at - 1], way[at]];
      if (isLost(before) || isLost(here)) continue;
      ink.globalAlpha = before.known && here.known ? 0.9 : 0.35;
      ink.beginPath();
      ink.moveTo(...this.toScreen(...before.at));
      ink.lineTo(...this.toScreen(...here.at));
      ink.stroke();
    }
    ink.globalAlpha = 1;
    const last = way.at(-1);
    if (!last || isLost(last)) return;
    ink.beginPath();
    ink.arc(...this.toScreen(...last.at), 9, 0, 6.2832);
    // Hollow where the robot may be elsewhere.
    if (last.known) ink.fill(); else ink.stroke();
  }

  drawMarkers() {
    const { ink, colours } = this;
    ink.textAlign = "center";
    ink.textBaseline = "middle";
    ink.font = "600 12px system-ui, sans-serif";
    for (const { at, label, kind } of [...this.markers].reverse()) {
      const [x, y] = this.toScreen(...at);
      const best = kind === "estimate";
      ink.lineWidth = 2;
      ink.strokeStyle = ink.fillStyle = best ? colours.bad : colours.ink;
      if (best) { ink.beginPath(); ink.arc(x, y, 17, 0, 6.2832); ink.stroke(); }
      ink.beginPath();
      ink.arc(x, y, 11, 0, 6.2832);
      ink.fill();
      ink.fillStyle = colours.card;
      ink.fillText(label, x, y + 0.5);
    }
    if (!this.chosen?.pose || !this.plane) return;
    const [x, y] = this.toScreen(...this.plane.project(this.chosen.pose));
    ink.strokeStyle = colours.ink;
    ink.lineWidth = 2.5;
    ink.beginPath();
    ink.arc(x, y, 10, 0, 6.2832);
    ink.stroke();
  }

  /** A round length for the scale bar, 60 to 150 pixels long. */
  span() {
    const most = 150 / this.scale;
    const power = 10 ** Math.floor(Math.log10(most));
    return [5, 2, 1].map((step) => step * power).find((length) => length <= most);
  }

  drawScale(colours) {
    const { ink } = this;
    const length = this.span();
    ink.fillStyle = colours.card;
    ink.globalAlpha = 0.85;
    ink.fillRect(6, 3, length * this.scale + 16, 27);
    ink.globalAlpha = 1;
    ink.strokeStyle = ink.fillStyle = colours.muted;
    ink.lineWidth = 1.5;
    ink.beginPath();
    ink.moveTo(14, 18);
    ink.lineTo(14, 24);
    ink.lineTo(14 + length * this.scale, 24);
    ink.lineTo(14 + length * this.scale, 18);
    ink.stroke();
    ink.font = "12px system-ui, sans-serif";
    ink.textAlign = "left";
    ink.textBaseline = "alphabetic";
    ink.fillText(metres(length), 20, 17);
  }

  drawLines() {
    const { ink, size: [w, h] } = this;
    const step = this.span();
    const [x0, y0, x1, y1] = this.bounds();
    ink.strokeStyle = this.colours.line;
    ink.lineWidth = 1;
    ink.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) { const at = Math.round(this.toScreen(x, 0)[0]) + 0.5; ink.moveTo(at, 0); ink.lineTo(at, h); }
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) { const at = Math.round(this.toScreen(0, y)[1]) + 0.5; ink.moveTo(0, at); ink.lineTo(w, at); }
    ink.stroke();
  }

  drawTiles() {
    const { plane: { span, mx, my }, ink } = this;
    const zoom = Math.min(19, Math.max(0, Math.round(Math.log2((span * this.scale) / 256))));
    const many = 2 ** zoom;
    const edge = (span / many) * this.scale;
    const [x0, y0, x1, y1] = this.bounds();
    const [left, right] = [x0, x1].map((x) => Math.floor((x / span + mx) * many));
    const [top, bottom] = [y1, y0].map((y) => Math.max(0, Math.min(many - 1, Math.floor((my - y / span) * many))));
    if (right - left > 40 || bottom - top > 40) return;
    ink.globalAlpha = this.dark ? 0.35 : 1; // tiles are designed for a light background
    for (let column = left; column <= right; column += 1) {
      for (let line = top; line <= bottom; line += 1) {
        const tile = this.tile(zoom, ((column % many) + many) % many, line);
        if (!tile) continue;
        const [x, y] = this.toScreen(span * (column / many - mx), span * (my - line / many));
        ink.drawImage(tile, x, y, edge + 0.5, edge + 0.5);
      }
    }
    ink.globalAlpha = 1;
  }

  tile(z, x, y) {
    const source = this.tiles.replace("{z}", z).replace("{x}", x).replace("{y}", y);
    let tile = this.loaded.get(source);
    if (!tile) {
      if (this.loaded.size > 300) this.loaded.delete(this.loaded.keys().next().value);
      tile = new Image();
      tile.addEventListener("load", () => this.touch());
      tile.src = source;
      this.loaded.set(source, tile);
    }
    return tile.complete && tile.naturalWidth ? tile : null;
  }
}

