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
  beginLive() {
    this.live = { paths: [], x: [], y: [] };
    this.arrange();
  }

  /** Add the next part of the path of that start, or section points of it. */
  addLive(kind, piece) {
    if (!this.live) return;
    if (kind === "path") {
      this.live.paths.push(piece);
      this.arrange();
      return;
    }
    this.live.x.push(...piece.section(this.pair[0]));
    this.live.y.push(...piece.section(this.pair[1]));
    for (const key of ["x", "y"]) this.live[key] = this.live[key].slice(-LIVE_KEPT);
    this.frame.repaint();
  }

  /** Give the section points of that start the colour of what it ends on. */
  endLive(colour) {
    if (!this.live) return;
    this.live.colour = colour;
    this.frame.repaint();
  }

  arrange() {
    const { orbit, live } = this, paths = live?.paths ?? [];
    if (!orbit && !paths.length) return;
    const columns = (name) => [...(orbit ? [orbit] : []), ...paths].map((part) => part.column(name));
    const [xs, ys] = this.pair.map(columns);
    this.wx = sharedWrapping(xs, this.frame.xAxis.angle);
    this.wy = sharedWrapping(ys, this.frame.yAxis.angle);
    const lines = xs.map((x, k) => brokenLines(x, ys[k], this.wx[k], this.wy[k]));
    this.lines = orbit ? lines.shift() : [];
    this.liveLines = lines.flat();
    this.points = orbit ? this.places(orbit.section(this.pair[0]), orbit.section(this.pair[1])) : [];
    let bounds = [Infinity, -Infinity, Infinity, -Infinity];
    for (const line of [...this.lines, ...this.liveLines, this.points.flat()]) bounds = reach(line, bounds);
    this.frame.fit(...bounds);
    this.label();
  }

  places(x, y) {
    const main = this.orbit ?? this.live.paths[0], [ax, ay] = [this.frame.xAxis.angle, this.frame.yAxis.angle];
    const near = this.pair.map((name, k) => (main?.n ? main.column(name)[0] + (k ? this.wy : this.wx)[0].shift : 0));
    return Array.from(x, (value, i) => [wrapped(value, this.wx[0], ax, near[0]), wrapped(y[i], this.wy[0], ay, near[1])]);
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
      const places = this.live.paths.length ? this.places(this.live.x, this.live.y) : [];
      // squares: section points of the orbit are discs
      ctx.fillStyle = this.live.colour ?? colours.warn;
      for (const [x, y] of places) ctx.fillRect(frame.x(x) - 2, frame.y(y) - 2, 4, 4);
    }
  }

  paintNow(ctx, frame, colours) {
    if (!this.orbit || this.orbit.n < 2) return;
    const [x, y] = this.pair.map((name) => this.now(name));
    ctx.beginPath();
    ctx.arc(frame.x(wrapped(x, this.wx[0])), frame.y(wrapped(y, this.wy[0])), 5, 0, 2 * Math.PI);
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

/** One wrapping for each of several lines in a picture: all are cut if together they span more than a turn. */
function sharedWrapping(columns, isAngle) {
  const own = columns.map((values) => wrappingOf(values, isAngle));
  if (!isAngle) return own;
  let [low, high] = [Infinity, -Infinity];
  columns.forEach((values, k) => {
    const [a, b] = extent(values);
    [low, high] = [Math.min(low, a + own[k].shift), Math.max(high, b + own[k].shift)];
  });
  const cut = own.some((entry) => entry.cut) || high - low >= 2 * Math.PI;
  return cut ? own.map(() => ({ shift: 0, cut: true })) : own;
}

function reach(line, [x0, x1, y0, y1]) {
  for (let i = 0; i + 1 < line.length; i += 2) {
    [x0, x1, y0, y1] = [Math.min(x0, line[i]), Math.max(x1, line[i]), Math.min(y0, line[i + 1]), Math.max(y1, line[i + 1])];
  }
  return [x0, x1, y0, y1];
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
    this.chosen = null;
    this.chooser(body, view, clock);
  }

  /** Choice of a further pair; the two fields are of no use where all pairs are shown. */
  chooser(body, view, clock) {
    const names = [...view.model.states, ...(view.model.quantities ?? [])];
    if (names.length < 3) return;
    const options = names.map((entry) => [entry.name, entry.label || entry.name]);
    const change = () => {
      upwards.element.hidden = !across.select.value;
      this.replace(across.select.value ? [across.select.value, upwards.select.value] : null, clock);
    };
    const across = labelledSelect("Another: across", [["", "none"], ...options], "", change);
    const upwards = labelledSelect("upwards", options, names[1].name, change);
    upwards.element.hidden = true;
    body.append(el("div", { class: "controls" }, across.element, upwards.element));
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

  beginLive() {
    for (const portrait of this.all) portrait.beginLive();
  }

  addLive(kind, piece) {
    for (const portrait of this.all) portrait.addLive(kind, piece);
  }

  endLive(colour) {
    for (const portrait of this.all) portrait.endLive(colour);
  }

  get frames() {
    return this.all.map((portrait) => portrait.frame);
  }

  destroy() {
    for (const portrait of this.all) portrait.destroy();
  }
}
