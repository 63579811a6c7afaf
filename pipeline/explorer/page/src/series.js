// States and quantities against time, one strip for each, with the cursor of the shared clock.

import { el, labelledSelect } from "./dom.js";
import { number } from "./facts.js";
import { extent, Frame } from "./frame.js";
import { axisOf, colourOf } from "./orbit.js";
import { brokenLines, wrapped, wrappingOf } from "./wrapping.js";
import { locate } from "./clock.js";

const STRIP = 92, FOOT = 36;

export class Series {
  /**
   * @param {Element} body
   * @param {Object} view
   * @param {import("./clock.js").Clock} clock
   */
  constructor(body, view, clock) {
    [this.view, this.clock, this.orbit] = [view, clock, null];
    this.names = view.model.states.map((state) => state.name).slice(0, 4);
    this.host = el("div", { class: "strips" });
    this.readout = el("output", { class: "readout" });
    body.append(this.host, this.chooser(), this.readout);
    this.strips = [];
    this.rebuild();
    this.forget = clock.on(() => this.move());
  }

  destroy() {
    this.forget();
    for (const strip of this.strips) strip.frame.destroy();
  }

  get frames() {
    return this.strips.map((strip) => strip.frame);
  }

  chooser() {
    const { states, quantities = [] } = this.view.model;
    const options = [["", "all states"], ...[...states, ...quantities].map((entry) => [entry.name, entry.label || entry.name])];
    const field = labelledSelect("Show", options, "", (name) => {
      this.names = name ? [name] : states.map((state) => state.name).slice(0, 4);
      this.rebuild();
    });
    return el("div", { class: "controls" }, field.element);
  }

  rebuild() {
    for (const strip of this.strips) strip.frame.destroy();
    this.strips = this.names.map((name, k) => this.strip(name, k === this.names.length - 1));
    if (this.orbit) this.show(this.orbit);
  }

  strip(name, isLast) {
    const axis = axisOf(this.view.model, name);
    const tall = this.names.length === 1 ? 2.2 * STRIP : STRIP;
    const frame = new Frame(this.host, { label: `${axis.label} against time`, height: tall + (isLast ? FOOT : 10), foot: isLast ? FOOT : 10 });
    frame.yAxis = axis;
    frame.xAxis = { label: isLast ? "time [s]" : "", angle: false, bare: !isLast };
    const strip = { name, frame, lines: [], wrapping: { shift: 0, cut: false } };
    frame.paintBack = (ctx, f, colours) => {
      if (!this.orbit) return;
      ctx.strokeStyle = colourOf(this.orbit, this.view, colours);
      ctx.lineWidth = 1.6;
      ctx.setLineDash(this.orbit.stable === false ? [7, 4] : []);
      f.trace(ctx, strip.lines);
      ctx.stroke();
      ctx.setLineDash([]);
    };
    frame.paintFront = (ctx, f, colours) => this.paintCursor(ctx, f, colours, strip);
    this.draggable(frame);
    return strip;
  }

  draggable(frame) {
    const seek = (event) => {
      const place = frame.at(event);
      if (place && this.orbit) this.clock.seek(place[0] - this.orbit.begin);
    };
    frame.front.addEventListener("pointerdown", (event) => {
      frame.front.setPointerCapture(event.pointerId);
      this.clock.pause();
      seek(event);
    });
    frame.front.addEventListener("pointermove", (event) => {
      if (event.buttons) seek(event);
    });
  }

  show(orbit) {
    this.orbit = orbit;
    for (const strip of this.strips) {
      const values = orbit.column(strip.name);
      strip.wrapping = wrappingOf(values, strip.frame.yAxis.angle);
      strip.lines = values.length ? brokenLines(orbit.time, values, { shift: 0, cut: false }, strip.wrapping) : [];
      const shown = strip.lines.flatMap((line) => line.filter((_, i) => i % 2 === 1));
      strip.frame.fit(orbit.begin, orbit.begin + orbit.duration, ...extent(shown), 0.08);
      strip.frame.wanted[0] = orbit.begin;
      strip.frame.wanted[1] = orbit.begin + (orbit.duration || 1);
    }
    this.move();
  }

  value(name) {
    const [low, high, part] = locate(this.orbit.time, this.orbit.begin + this.clock.time);
    const values = this.orbit.column(name);
    return values[low] + part * (values[high] - values[low]);
  }

  paintCursor(ctx, frame, colours, strip) {
    if (!this.orbit || this.orbit.n < 2) return;
    const x = frame.x(this.orbit.begin + this.clock.time);
    ctx.strokeStyle = colours.ink;
    ctx.lineWidth = 1;
    ctx.beginPath();
    ctx.moveTo(x, frame.box.top);
    ctx.lineTo(x, frame.box.top + frame.box.height);
    ctx.stroke();
    ctx.beginPath();
    ctx.arc(x, frame.y(wrapped(this.value(strip.name), strip.wrapping)), 4, 0, 2 * Math.PI);
    ctx.fillStyle = colours.ink;
    ctx.fill();
  }

  move() {
    for (const strip of this.strips) strip.frame.refresh();
    if (!this.orbit || this.orbit.n < 2 || this.clock.playing) return;
    const parts = this.strips.map(({ name, frame, wrapping }) => `${frame.yAxis.label.split(" [")[0]} = ${number(wrapped(this.value(name), wrapping))}`);
    this.readout.textContent = `t = ${this.clock.time.toFixed(3)} s: ${parts.join(", ")}`;
  }
}
