// Exponents and fractions below the diagram, over the same part of the same axis.

import { FONT, boxOf, paintAxes, paintFrame, placeX, placeY, told } from "./axes.js";
import { el } from "./dom.js";
import { Gestures } from "./gestures.js";
import { visible } from "./palette.js";
import { onTheme, theme } from "./theme.js";

export const GROUPS = { exponents: "Exponents", fractions: "Fractions" };

export class Curves {
  constructor(state, source, view, diagram, reader) {
    Object.assign(this, { state, source, view, diagram, reader });
    this.element = el("div", { class: "curves" });
    this.strips = Object.keys(GROUPS).map((group) => new Strip(group, this));
    this.element.append(...this.strips.map((strip) => strip.element));
    state.on(["x", "at"], () => this.load());
    state.on(["overlays"], () => this.show());
    state.on(["window", "selected"], () => this.repaint());
    this.forget = onTheme(() => this.repaint());
    this.load();
  }

  destroy() {
    this.forget();
  }

  async load() {
    const { x, at } = this.state.get(), wanted = JSON.stringify([x, at]);
    this.wanted = wanted;
    try {
      const { curves } = await this.source.curves({ x, at });
      if (wanted !== this.wanted) return;
      for (const strip of this.strips) strip.take(curves.filter(({ group }) => group === strip.group));
      this.onLoaded?.();
    } catch (error) {
      if (wanted === this.wanted) this.reader.say(error.message);
    }
    this.show();
  }

  show() {
    const { overlays } = this.state.get();
    for (const strip of this.strips) strip.element.hidden = !overlays[strip.group] || !strip.curves.length;
    this.repaint();
  }

  has(group) {
    return this.strips.some((strip) => strip.group === group && strip.curves.length);
  }

  repaint() {
    for (const strip of this.strips) strip.repaint();
  }

  /** The strips that are shown, for a picture of all. */
  get shown() {
    return this.strips.filter((strip) => !strip.element.hidden);
  }
}

class Strip {
  constructor(group, curves) {
    Object.assign(this, { group, owner: curves, curves: [], width: 0, height: 0 });
    this.canvas = el("canvas", { role: "img", "aria-label": GROUPS[group] });
    this.names = el("ul", { class: "curve-names", tabindex: "0", "aria-label": `${GROUPS[group]}, what is drawn` });
    this.plot = el("div", { class: "strip-plot" }, this.canvas);
    this.element = el("section", { class: "strip", "aria-label": GROUPS[group], hidden: true }, this.names, this.plot);
    this.gestures = new Gestures(this.plot, {
      takesWheel: () => curves.diagram.takesWheel,
      box: () => this.box, level: true, window: () => curves.diagram.window,
      set: (bounds) => curves.diagram.moveTo(bounds), reset: () => curves.diagram.reset(),
    });
    new ResizeObserver(() => this.measure()).observe(this.plot);
  }

  take(curves) {
    this.curves = curves;
    this.names.replaceChildren(...curves.map(({ title, colour }) => {
      const swatch = el("span", { class: "swatch" });
      swatch.style.background = colour;
      return el("li", {}, swatch, title);
    }));
    this.canvas.setAttribute("aria-label", `${GROUPS[this.group]}: ${curves.map(({ title }) => title).join(", ")}`);
  }

  measure() {
    const width = Math.floor(this.plot.clientWidth), height = Math.floor(this.plot.clientHeight);
    if (!width || !height) return;
    this.pixels = window.devicePixelRatio || 1;
    [this.width, this.height, this.box] = [width, height, boxOf(width, height, { foot: 6, top: 6 })];
    [this.canvas.width, this.canvas.height] = [Math.round(width * this.pixels), Math.round(height * this.pixels)];
    this.repaint();
  }

  repaint() {
    if (this.frame || this.element.hidden) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      if (!this.width || this.element.hidden) return;
      const ctx = this.canvas.getContext("2d");
      ctx.setTransform(this.pixels, 0, 0, this.pixels, 0, 0);
      ctx.clearRect(0, 0, this.width, this.height);
      this.paint(ctx, this.box, theme());
    });
  }

  /** Paint the curves into any context. */
  paint(ctx, box, colours) {
    const [x0, x1] = this.owner.diagram.window, [low, high] = this.range(x0, x1), bounds = [x0, x1, low, high];
    const unit = this.curves[0]?.unit ?? "";
    ctx.font = FONT;
    paintAxes(ctx, box, bounds, { x: { factor: this.owner.diagram.horizontal?.factor }, y: { label: this.group === "fractions" ? "fraction" : "λ", unit } }, colours);
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.width, box.height);
    ctx.clip();
    if (low < 0 && high > 0) {
      ctx.fillStyle = colours.muted;
      ctx.fillRect(box.left, Math.round(placeY(box, bounds, 0)), box.width, 1);
    }
    const paintOne = this.group === "fractions" ? paintSteps : paintCurve;
    for (const curve of this.curves) paintOne(ctx, box, bounds, curve, visible(curve.colour, colours.card));
    const chosen = this.owner.diagram.selection;
    if (chosen) {
      ctx.globalAlpha = 0.45;
      ctx.fillStyle = colours.ink;
      ctx.fillRect(Math.round(placeX(box, bounds, chosen.x)), box.top, 1, box.height);
      ctx.globalAlpha = 1;
    }
    ctx.restore();
    paintFrame(ctx, box, colours);
  }

  range(x0, x1) {
    if (this.group === "fractions") return [-0.05, 1.05];
    let [low, high] = [0, 0];
    for (const { x, y } of this.curves) {
      for (let i = 0; i < x.length; i++) {
        if (y[i] === null || x[i] < x0 || x[i] > x1) continue;
        low = Math.min(low, y[i]);
        high = Math.max(high, y[i]);
      }
    }
    const room = 0.08 * (high - low) || 1;
    return [low - room, high + room];
  }

  /** What the curves say at a place. */
  at(x) {
    return this.curves.map(({ title, x: xs, y }) => {
      let nearest = 0;
      for (let i = 1; i < xs.length; i++) if (Math.abs(xs[i] - x) < Math.abs(xs[nearest] - x)) nearest = i;
      return `${title} ${y[nearest] === null ? "absent" : told(y[nearest])}`;
    });
  }
}

/** Limits of the column of each value of the axis: half way to its neighbours. */
function columnEdges(x) {
  const edges = x.slice(1).map((value, i) => (x[i] + value) / 2), last = x.length - 1;
  if (!last) return [x[0] - 0.05 * Math.abs(x[0] || 1), x[0] + 0.05 * Math.abs(x[0] || 1)];
  return [2 * x[0] - edges[0], ...edges, 2 * x[last] - edges[last - 1]];
}

/** Paint shares as steps: a column for each value of the axis, none where the attractor is absent. */
function paintSteps(ctx, box, bounds, { x, y, low, high }, colour) {
  const px = columnEdges(x).map((value) => placeX(box, bounds, value)), py = y.map((value) => placeY(box, bounds, value));
  ctx.fillStyle = ctx.strokeStyle = colour;
  if (low && high) {
    ctx.globalAlpha = 0.18;
    for (let i = 0; i < x.length; i++) {
      if (y[i] === null || low[i] === null || high[i] === null) continue;
      const top = placeY(box, bounds, high[i]);
      ctx.fillRect(px[i], top, px[i + 1] - px[i], placeY(box, bounds, low[i]) - top);
    }
  }
  // risers are faint: many jumps must not become a slab
  ctx.globalAlpha = 0.35;
  ctx.lineWidth = 1;
  ctx.beginPath();
  for (let i = 1; i < x.length; i++) {
    if (y[i] === null || y[i - 1] === null || y[i] === y[i - 1]) continue;
    ctx.moveTo(px[i], py[i - 1]);
    ctx.lineTo(px[i], py[i]);
  }
  ctx.stroke();
  ctx.globalAlpha = 1;
  for (let from = 0, to; from < x.length; from = to) {
    for (to = from + 1; to < x.length && y[to] === y[from]; to++);
    if (y[from] !== null) ctx.fillRect(px[from], py[from] - 1, Math.max(px[to] - px[from], 1.5), 2);
  }
}

function paintCurve(ctx, box, bounds, { x, y, low, high }, colour) {
  if (low && high) paintBand(ctx, box, bounds, x, low, high, colour);
  ctx.strokeStyle = ctx.fillStyle = colour;
  ctx.lineWidth = 1.5;
  ctx.lineJoin = "round";
  ctx.beginPath();
  let pen = false;
  const single = [];
  for (let i = 0; i < x.length; i++) {
    if (y[i] === null) {
      pen = false;
      continue;
    }
    const px = placeX(box, bounds, x[i]), py = placeY(box, bounds, y[i]);
    if (pen) ctx.lineTo(px, py);
    else ctx.moveTo(px, py);
    if (!pen && (i === x.length - 1 || y[i + 1] === null)) single.push([px, py]);
    pen = true;
  }
  ctx.stroke();
  for (const [px, py] of single) {
    ctx.beginPath();
    ctx.arc(px, py, 2, 0, 2 * Math.PI);
    ctx.fill();
  }
}

function paintBand(ctx, box, bounds, x, low, high, colour) {
  ctx.globalAlpha = 0.18;
  ctx.fillStyle = colour;
  let from = 0;
  while (from < x.length) {
    while (from < x.length && (low[from] === null || high[from] === null)) from++;
    let to = from;
    while (to < x.length && low[to] !== null && high[to] !== null) to++;
    if (to - from > 1) {
      ctx.beginPath();
      for (let i = from; i < to; i++) ctx.lineTo(placeX(box, bounds, x[i]), placeY(box, bounds, high[i]));
      for (let i = to - 1; i >= from; i--) ctx.lineTo(placeX(box, bounds, x[i]), placeY(box, bounds, low[i]));
      ctx.closePath();
      ctx.fill();
    }
    from = to + 1;
  }
  ctx.globalAlpha = 1;
}
