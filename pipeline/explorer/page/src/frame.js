// A picture with two axes on two canvases: the lower is painted when data change, the upper with each
// frame of a moving cursor. Sizes follow the element and the device's pixels.

import { el } from "./dom.js";
import { onTheme, theme } from "./theme.js";

const FONT = "12px system-ui, sans-serif";

/** Round numbers between two bounds, some `count` of them. */
export function ticks(low, high, count) {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return [];
  const power = 10 ** Math.floor(Math.log10(span / count));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => span / s <= count) ?? 10 * power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found.map((value) => [value, tickLabel(value, step)]);
}

function tickLabel(value, step) {
  if (Math.abs(value) < 1e-9 * step) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(1).replace("-", "−").replace("e+", "e");
  return value.toFixed(Math.min(8, Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)))).replace("-", "−");
}

/** Multiples of a part of π, for angles that span a good part of a turn. */
export function angleTicks(low, high, count) {
  if (high - low < 2) return ticks(low, high, count);
  const parts = [[1, 4], [1, 2], [1, 1], [2, 1], [4, 1], [8, 1]];
  const [n, d] = parts.find(([a, b]) => (high - low) / ((Math.PI * a) / b) <= count) ?? parts.at(-1);
  const found = [];
  for (let k = Math.ceil((low * d) / (Math.PI * n) - 1e-9); (k * Math.PI * n) / d <= high + 1e-9; k++) {
    found.push([(k * Math.PI * n) / d, partOfPi(k * n, d)]);
  }
  return found;
}

function partOfPi(k, d) {
  if (k === 0) return "0";
  let n = Math.abs(k);
  while (d > 1 && n % 2 === 0) [n, d] = [n / 2, d / 2];
  return `${k < 0 ? "−" : ""}${n === 1 ? "" : n}π${d === 1 ? "" : `/${d}`}`;
}

export class Frame {
  /**
   * @param {Element} host
   * @param {{label: string, height?: number, ratio?: number, equal?: boolean, axes?: boolean, foot?: number}} options
   *   `ratio` is height by width where no height is given; `equal` gives both axes one scale; `foot` is the room
   *   below the axes
   */
  constructor(host, options) {
    this.options = options;
    this.back = el("canvas", { "aria-hidden": "true" });
    this.front = el("canvas", { role: "img", "aria-label": options.label });
    this.element = el("div", { class: "frame" }, this.back, this.front);
    host.append(this.element);
    this.limits = [0, 1, 0, 1];
    this.xAxis = { label: "", angle: false };
    this.yAxis = { label: "", angle: false };
    this.paintBack = null;
    this.paintFront = null;
    this.width = this.height = 0;
    this.pending = false;
    this.observer = new ResizeObserver(() => this.measure());
    this.observer.observe(this.element);
    this.forget = onTheme(() => this.repaint());
    this.measure();
  }

  destroy() {
    this.observer.disconnect();
    this.forget();
    this.element.remove();
  }

  setLabel(label) {
    this.front.setAttribute("aria-label", label);
  }

  measure() {
    const width = Math.floor(this.element.clientWidth);
    if (width === 0) return;
    const height = this.options.height ?? Math.round(width * (this.options.ratio ?? 0.75));
    const pixels = window.devicePixelRatio || 1;
    if (width === this.width && height === this.height && pixels === this.pixels) return;
    [this.width, this.height, this.pixels] = [width, height, pixels];
    for (const canvas of [this.back, this.front]) {
      canvas.width = Math.round(width * pixels);
      canvas.height = Math.round(height * pixels);
      canvas.style.width = `${width}px`;
      canvas.style.height = `${height}px`;
    }
    this.element.style.height = `${height}px`;
    this.repaint();
  }

  /** Set the bounds of both axes, a little wider than the data's. */
  fit(x0, x1, y0, y1, margin = 0.06) {
    [x0, x1] = widened(x0, x1, margin);
    [y0, y1] = widened(y0, y1, margin);
    this.wanted = [x0, x1, y0, y1];
    this.repaint();
  }

  place() {
    const bare = this.options.axes === false;
    const edge = bare ? { left: 4, right: 4, top: 4, bottom: 4 } : { left: 56, right: 12, top: 8, bottom: this.options.foot ?? 36 };
    this.box = {
      left: edge.left, top: edge.top, width: Math.max(10, this.width - edge.left - edge.right),
      height: Math.max(10, this.height - edge.top - edge.bottom),
    };
    let [x0, x1, y0, y1] = this.wanted ?? [0, 1, 0, 1];
    if (this.options.equal) {
      const scale = Math.max((x1 - x0) / this.box.width, (y1 - y0) / this.box.height);
      const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
      [x0, x1] = [cx - (scale * this.box.width) / 2, cx + (scale * this.box.width) / 2];
      [y0, y1] = [cy - (scale * this.box.height) / 2, cy + (scale * this.box.height) / 2];
    }
    this.limits = [x0, x1, y0, y1];
  }

  x(value) {
    return this.box.left + ((value - this.limits[0]) / (this.limits[1] - this.limits[0])) * this.box.width;
  }

  y(value) {
    return this.box.top + ((this.limits[3] - value) / (this.limits[3] - this.limits[2])) * this.box.height;
  }

  /** Data coordinates of a pointer's event, or null outside of the axes. */
  at(event) {
    const rect = this.front.getBoundingClientRect();
    const px = event.clientX - rect.left - this.box.left, py = event.clientY - rect.top - this.box.top;
    if (px < 0 || py < 0 || px > this.box.width || py > this.box.height) return null;
    const [x0, x1, y0, y1] = this.limits;
    return [x0 + (px / this.box.width) * (x1 - x0), y1 - (py / this.box.height) * (y1 - y0)];
  }

  /** Paint all at the next frame. */
  repaint() {
    this.stale = true;
    this.refresh();
  }

  /** Paint the upper canvas at the next frame. */
  refresh() {
    if (this.pending || this.width === 0) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      if (this.stale) this.paintLower();
      this.paintUpper();
    });
  }

  /** Paint all of the picture onto a context of the same size, for a file. */
  paintInto(ctx) {
    this.place();
    ctx.lineJoin = ctx.lineCap = "round";
    ctx.font = FONT;
    if (this.options.axes !== false) this.paintAxes(ctx);
    this.clipped(ctx, this.paintBack);
    this.clipped(ctx, this.paintFront);
  }

  begin(canvas) {
    const ctx = canvas.getContext("2d");
    ctx.setTransform(this.pixels, 0, 0, this.pixels, 0, 0);
    ctx.clearRect(0, 0, this.width, this.height);
    ctx.lineJoin = ctx.lineCap = "round";
    ctx.font = FONT;
    return ctx;
  }

  paintLower() {
    this.stale = false;
    this.place();
    const ctx = this.begin(this.back);
    if (this.options.axes !== false) this.paintAxes(ctx);
    this.clipped(ctx, this.paintBack);
  }

  paintUpper() {
    this.clipped(this.begin(this.front), this.paintFront);
  }

  clipped(ctx, paint) {
    if (!paint) return;
    ctx.save();
    ctx.beginPath();
    ctx.rect(this.box.left, this.box.top, this.box.width, this.box.height);
    ctx.clip();
    paint(ctx, this, theme());
    ctx.restore();
  }

  paintAxes(ctx) {
    const { left, top, width, height } = this.box, [x0, x1, y0, y1] = this.limits, colours = theme();
    const xs = (this.xAxis.angle ? angleTicks : ticks)(x0, x1, Math.max(2, width / 70));
    const ys = (this.yAxis.angle ? angleTicks : ticks)(y0, y1, Math.max(3, height / 36));
    ctx.lineWidth = 1;
    ctx.strokeStyle = colours.grid;
    ctx.beginPath();
    for (const [value] of xs) ctx.rect(Math.round(this.x(value)), top, 0, height);
    for (const [value] of ys) ctx.rect(left, Math.round(this.y(value)), width, 0);
    ctx.stroke();
    ctx.strokeStyle = colours.line;
    ctx.strokeRect(left + 0.5, top + 0.5, width - 1, height - 1);
    ctx.fillStyle = colours.muted;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    if (!this.xAxis.bare) for (const [value, text] of xs) ctx.fillText(text, this.x(value), top + height + 4);
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    for (const [value, text] of ys) ctx.fillText(text, left - 5, this.y(value));
    ctx.fillStyle = colours.ink;
    ctx.textAlign = "center";
    ctx.textBaseline = "bottom";
    ctx.fillText(this.xAxis.label, left + width / 2, this.height - 2);
    ctx.save();
    ctx.translate(2, top + height / 2);
    ctx.rotate(-Math.PI / 2);
    ctx.textBaseline = "top";
    ctx.fillText(this.yAxis.label, 0, 0);
    ctx.restore();
  }

  /** Add lines of `brokenLines` to the path of a context. */
  trace(ctx, lines) {
    ctx.beginPath();
    for (const line of lines) {
      ctx.moveTo(this.x(line[0]), this.y(line[1]));
      for (let i = 2; i < line.length; i += 2) ctx.lineTo(this.x(line[i]), this.y(line[i + 1]));
    }
  }
}

function widened(low, high, margin) {
  if (!(high >= low)) return [0, 1];
  const least = 1e-9 * Math.max(Math.abs(low), Math.abs(high)) || 1e-3;
  const room = Math.max(margin * (high - low), least);
  return [low - room, high + room];
}

/** Least and greatest of values that are finite. */
export function extent(values, low = Infinity, high = -Infinity) {
  for (let i = 0; i < values.length; i++) {
    if (values[i] < low) low = values[i];
    if (values[i] > high) high = values[i];
  }
  return [low, high];
}
