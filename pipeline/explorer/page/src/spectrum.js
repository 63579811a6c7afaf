// The spectrum of the shown orbit: lines of a closed one, over exactly its period; otherwise of the periods shown.

import { el, labelledSelect } from "./dom.js";
import { number } from "./facts.js";
import { Frame } from "./frame.js";
import { axisOf, colourOf } from "./orbit.js";

/** Highest multiple of the drive's frequency, or of the rate of returns; decades below the largest line. */
const ORDERS = 10, DECADES = 5;

/** Lines that are told in words. */
const TOLD = 4;

export class Spectrum {
  constructor(body, view) {
    Object.assign(this, { view, orbit: null, lines: [] });
    const { states, quantities = [] } = view.model;
    this.name = states[0].name;
    const options = [...states, ...quantities].map((entry) => [entry.name, entry.label || entry.name]);
    const field = labelledSelect("Show", options, this.name, (name) => {
      this.name = name;
      if (this.orbit) this.show(this.orbit);
    });
    this.frame = new Frame(body, { label: "Spectrum", ratio: 0.6 });
    this.frame.paintBack = (ctx, frame, colours) => this.paint(ctx, frame, colours);
    this.note = el("p", { class: "note" });
    body.append(el("div", { class: "controls" }, field.element), this.note);
  }

  destroy() {
    this.frame.destroy();
  }

  show(orbit) {
    this.orbit = orbit;
    const axis = axisOf(this.view.model, this.name), { frequency, period } = orbit.attrs;
    const isClosed = Boolean(period), hertz = frequency ?? (isClosed ? period / orbit.duration : null);
    this.lines = linesOf(orbit, this.name, axis.angle, isClosed, hertz);
    const unit = frequency ? 1 / frequency : 1;
    this.places = this.lines.map((_, k) => ((k + 1) / orbit.duration) * unit);
    const high = Math.max(...this.lines, 0), top = Math.log10(high || 1), known = high > 0;
    this.frame.element.hidden = !known;
    this.floor = top - DECADES;
    this.frame.xAxis = { label: frequency ? "order: multiple of the drive's frequency" : "frequency [Hz]", angle: false };
    this.frame.yAxis = { label: `log₁₀ amplitude of ${axis.label}`, angle: false };
    this.frame.fit(0, this.places.at(-1) ?? 1, this.floor, top, 0.04);
    const largest = this.lines.map((size, k) => [size, this.places[k]]).sort(([a], [b]) => b - a).slice(0, TOLD);
    const told = largest.filter(([size]) => size > 10 ** this.floor).map(([size, place]) => `${number(size)} at ${number(place)}${frequency ? "" : " Hz"}`);
    const words = isClosed ? `Lines: ${told.join(", ")}.` : `Of the time shown, ${number(orbit.duration)} s; magpend plot spectrum averages a longer one.`;
    this.note.textContent = known ? words : "This motion is at rest.";
    this.frame.setLabel(`Spectrum of ${axis.label}: ${words}`);
    this.frame.measure();
  }

  paint(ctx, frame, colours) {
    if (!this.orbit) return;
    ctx.strokeStyle = ctx.fillStyle = colourOf(this.orbit, this.view, colours);
    ctx.lineWidth = 1.6;
    const ys = this.lines.map((size) => Math.max(Math.log10(size), this.floor - 1));
    ctx.beginPath();
    if (!this.orbit.attrs.period) ys.forEach((y, k) => ctx.lineTo(frame.x(this.places[k]), frame.y(y)));
    else ys.forEach((y, k) => this.trace(ctx, frame, this.places[k], y));
    ctx.stroke();
  }

  /** Add a line with its top to the path of a context. */
  trace(ctx, frame, x, y) {
    if (y < this.floor) return;
    ctx.moveTo(frame.x(x), frame.y(this.floor - 1));
    ctx.lineTo(frame.x(x), frame.y(y));
    ctx.moveTo(frame.x(x) + 2, frame.y(y));
    ctx.arc(frame.x(x), frame.y(y), 2, 0, 2 * Math.PI);
  }
}

/** Amplitudes at the multiples of one over the orbit's duration; those of an orbit that is not closed by a Hann window. */
function linesOf(orbit, name, isAngle, isClosed, hertz) {
  const column = orbit.column(name), n = column.length - 1;
  if (n < 2 || !orbit.duration) return [];
  const turns = column[n] - column[0], slope = isAngle && (isClosed || Math.abs(turns) > 2 * Math.PI) ? turns / n : 0;
  const values = new Float64Array(n), weights = new Float64Array(n);
  let mean = 0, weight = 0;
  for (let i = 0; i < n; i++) mean += (column[i] - slope * i) / n;
  for (let i = 0; i < n; i++) {
    weights[i] = isClosed ? 1 : 1 - Math.cos((2 * Math.PI * i) / n);
    weight += weights[i];
    values[i] = (column[i] - slope * i - mean) * weights[i];
  }
  const most = Math.min(Math.floor((n - 1) / 2), Math.round(ORDERS * (hertz ? hertz * orbit.duration : n / 8)));
  const cosines = Float64Array.from({ length: n }, (_, i) => Math.cos((2 * Math.PI * i) / n));
  const sines = Float64Array.from({ length: n }, (_, i) => Math.sin((2 * Math.PI * i) / n));
  const found = [];
  for (let k = 1; k <= most; k++) {
    let [re, im, at] = [0, 0, 0];
    for (let i = 0; i < n; i++) {
      re += values[i] * cosines[at];
      im += values[i] * sines[at];
      at = (at + k) % n;
    }
    found.push((2 * Math.hypot(re, im)) / weight);
  }
  return found;
}
