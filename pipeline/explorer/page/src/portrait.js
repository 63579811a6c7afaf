// Phase portraits: the orbit as a line, its section points, where it is now, and what is integrated live.

import { el, labelledSelect } from "./dom.js";
import { extent, Frame } from "./frame.js";
import { axisOf, colourOf } from "./orbit.js";
import { brokenLines, wrapped, wrappingOf } from "./wrapping.js";
import { locate } from "./clock.js";

const LIVE_KEPT = 4000;

export class Portrait {
  /**
   * @param {Element} host
   * @param {Object} view
   * @param {[string, string]} pair names of states or quantities, across and upwards
   * @param {import("./clock.js").Clock} clock
   */
  constructor(host, view, pair, clock) {
    [this.view, this.pair, this.clock] = [view, pair, clock];
    this.frame = new Frame(host, { label: "", ratio: 0.85 });
    this.frame.xAxis = axisOf(view.model, pair[0]);
    this.frame.yAxis = axisOf(view.model, pair[1]);
    this.frame.paintBack = (ctx, frame, colours) => this.paint(ctx, frame, colours);
    this.frame.paintFront = (ctx, frame, colours) => this.paintNow(ctx, frame, colours);
    this.forget = clock.on(() => this.frame.refresh());
    this.orbit = this.live = null;
    this.label();
  }

  destroy() {
    this.forget();
    this.frame.destroy();
  }

  label() {
    const [x, y] = [this.frame.xAxis.label, this.frame.yAxis.label];
    const points = this.orbit ? `, ${this.orbit.section(this.pair[0]).length} section points` : "";
    this.frame.setLabel(`Phase portrait: ${y} against ${x}${points}`);
  }

  show(orbit) {
    this.orbit = orbit;
    this.live = null;
    this.arrange();
  }

  /** Begin to show a start that is being integrated. */
  beginLive(path) {
    this.live = { path, x: [], y: [] };
    this.arrange();
  }

  /** Add section points of the start that is being integrated. */
  addLive(piece) {
    if (!this.live) return;
    this.live.x.push(...piece.section(this.pair[0]));
    this.live.y.push(...piece.section(this.pair[1]));
    for (const key of ["x", "y"]) this.live[key] = this.live[key].slice(-LIVE_KEPT);
    this.frame.repaint();
  }

  arrange() {
    const [nx, ny] = this.pair, { xAxis, yAxis } = this.frame;
    const main = this.orbit ?? this.live?.path;
    if (!main) return;
    this.wx = wrappingOf(main.column(nx), xAxis.angle);
    this.wy = wrappingOf(main.column(ny), yAxis.angle);
    this.lines = this.orbit ? brokenLines(main.column(nx), main.column(ny), this.wx, this.wy) : [];
    this.points = this.orbit ? this.places(main.section(nx), main.section(ny)) : [];
    const lx = this.live ? wrappingOf(this.live.path.column(nx), xAxis.angle) : null;
    const ly = this.live ? wrappingOf(this.live.path.column(ny), yAxis.angle) : null;
    this.liveLines = this.live ? brokenLines(this.live.path.column(nx), this.live.path.column(ny), lx, ly) : [];
    const all = [...this.lines, ...this.liveLines, this.points.flat()];
    const xs = all.flatMap((line) => line.filter((_, i) => i % 2 === 0));
    const ys = all.flatMap((line) => line.filter((_, i) => i % 2 === 1));
    [this.xs, this.ys] = [extent(xs), extent(ys)];
    this.frame.fit(...this.xs, ...this.ys);
    this.label();
  }

  places(x, y) {
    const [ax, ay] = [this.frame.xAxis.angle, this.frame.yAxis.angle];
    return Array.from(x, (value, i) => [this.shown(value, this.wx, ax, "x"), this.shown(y[i], this.wy, ay, "y")]);
  }

  shown(value, wrapping, isAngle, side) {
    const main = (this.orbit ?? this.live?.path).column(this.pair[side === "x" ? 0 : 1]);
    const near = main.length ? main[0] + wrapping.shift : 0;
    return wrapped(value, wrapping, isAngle, near);
  }

  paint(ctx, frame, colours) {
    if (this.live) {
      ctx.strokeStyle = colours.muted;
      ctx.lineWidth = 1;
      frame.trace(ctx, this.liveLines);
      ctx.stroke();
    }
    if (this.orbit) {
      ctx.strokeStyle = colourOf(this.orbit, this.view, colours);
      ctx.lineWidth = 1.6;
      ctx.setLineDash(this.orbit.stable === false ? [7, 4] : []);
      frame.trace(ctx, this.lines);
      ctx.stroke();
      ctx.setLineDash([]);
      dots(ctx, frame, this.points, colours, this.points.length > 40 ? 1.6 : 3.6);
    }
    if (this.live) {
      const places = this.places(this.live.x, this.live.y);
      ctx.fillStyle = colours.warn;
      for (const [x, y] of places) ctx.fillRect(frame.x(x) - 1.5, frame.y(y) - 1.5, 3, 3);
    }
  }

  paintNow(ctx, frame, colours) {
    if (!this.orbit || this.orbit.n < 2) return;
    const [x, y] = this.pair.map((name) => this.now(name));
    ctx.beginPath();
    ctx.arc(frame.x(wrapped(x, this.wx)), frame.y(wrapped(y, this.wy)), 5, 0, 2 * Math.PI);
    ctx.fillStyle = colours.card;
    ctx.strokeStyle = colours.ink;
    ctx.lineWidth = 2;
    ctx.fill();
    ctx.stroke();
  }

  now(name) {
    const [low, high, part] = locate(this.orbit.time, this.orbit.begin + this.clock.time);
    const values = this.orbit.column(name);
    return values[low] + part * (values[high] - values[low]);
  }
}

function dots(ctx, frame, points, colours, radius) {
  ctx.fillStyle = colours.ink;
  ctx.strokeStyle = colours.card;
  ctx.lineWidth = 1;
  for (const [x, y] of points) {
    ctx.beginPath();
    ctx.arc(frame.x(x), frame.y(y), radius, 0, 2 * Math.PI);
    ctx.fill();
    if (radius > 2) ctx.stroke();
  }
}

/** Portraits of a model side by side; `show`, `beginLive` and `addLive` reach all of them. */
export class Portraits {
  constructor(body, view, clock) {
    this.host = el("div", { class: "portraits" });
    body.append(this.host);
    this.view = view;
    const pairs = view.model.portraits.slice(0, 3);
    this.all = pairs.map((pair) => new Portrait(this.host, view, pair, clock));
    this.chosen = this.chooser(body, view, clock, pairs);
  }

  chooser(body, view, clock, pairs) {
    const names = [...view.model.states, ...(view.model.quantities ?? [])];
    if (names.length < 3 && pairs.length) return null;
    const options = names.map((entry) => [entry.name, entry.label || entry.name]);
    const pair = [names[0].name, (names[1] ?? names[0]).name];
    const change = (side) => (name) => {
      pair[side] = name;
      this.replace([...pair], clock);
    };
    const across = labelledSelect("Another: across", [["", "none"], ...options], "", (name) => (name ? change(0)(name) : this.replace(null)));
    const upwards = labelledSelect("upwards", options, pair[1], (name) => (across.select.value ? change(1)(name) : (pair[1] = name)));
    body.append(el("div", { class: "controls" }, across.element, upwards.element));
    return null;
  }

  replace(pair, clock) {
    if (this.chosen) {
      this.chosen.destroy();
      this.all = this.all.filter((portrait) => portrait !== this.chosen);
      this.chosen = null;
    }
    if (!pair) return;
    this.chosen = new Portrait(this.host, this.view, pair, clock);
    this.all.push(this.chosen);
    if (this.orbit) this.chosen.show(this.orbit);
  }

  show(orbit) {
    this.orbit = orbit;
    for (const portrait of this.all) portrait.show(orbit);
  }

  beginLive(path) {
    for (const portrait of this.all) portrait.beginLive(path);
  }

  addLive(piece) {
    for (const portrait of this.all) portrait.addLive(piece);
  }

  destroy() {
    for (const portrait of this.all) portrait.destroy();
  }
}
