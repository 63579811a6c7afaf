// The model's drawing as it moves: joined points, points that stay, and the path of the traced one.

import { el, freshId, labelledSelect } from "./dom.js";
import { Frame } from "./frame.js";
import { colourOf } from "./orbit.js";
import { locate, SPEEDS } from "./clock.js";
import { wantsLessMotion } from "./theme.js";

export class Machine {
  /**
   * @param {Element} body
   * @param {Object} view
   * @param {import("./clock.js").Clock} clock
   */
  constructor(body, view, clock) {
    [this.view, this.clock, this.orbit] = [view, clock, null];
    this.drawing = view.model.drawing;
    if (this.drawing) {
      this.frame = new Frame(body, { label: "The moving model", ratio: 0.85, equal: true, axes: false });
      this.frame.paintBack = (ctx, frame, colours) => this.paintStill(ctx, frame, colours);
      this.frame.paintFront = (ctx, frame, colours) => this.paintMoving(ctx, frame, colours);
    }
    body.append(this.controls());
    this.forget = clock.on(() => this.move());
  }

  destroy() {
    this.forget();
    this.frame?.destroy();
  }

  controls() {
    this.button = el("button", { type: "button", class: "play", on: { click: () => this.toggle() } });
    const id = freshId("time");
    this.slider = el("input", {
      id, type: "range", min: 0, max: 1000, step: 1, value: 0,
      on: { input: () => this.scrub() },
    });
    this.told = el("span", { class: "told" });
    const speeds = SPEEDS.map((speed) => [String(speed), speed < 1 ? `1/${1 / speed}` : `${speed}`]);
    this.speed = labelledSelect("Speed", speeds, "1", (value) => (this.clock.speed = Number(value)));
    const scrubber = el("span", { class: "field grow" }, el("label", { for: id, text: "Time" }), this.slider, this.told);
    return el("div", { class: "controls" }, this.button, scrubber, this.speed.element);
  }

  toggle() {
    if (this.clock.playing) this.clock.pause();
    else this.clock.play();
  }

  scrub() {
    // read first: to pause puts the slider back to where the clock is
    const wanted = (this.slider.value / 1000) * this.clock.duration;
    this.clock.pause();
    this.clock.seek(wanted);
  }

  /** Show an orbit; `keep` leaves time and speed as they are, for one that is followed. */
  show(orbit, keep = false) {
    this.orbit = orbit;
    this.clock.reset(orbit.duration, keep);
    this.speed.select.value = String(this.clock.speed);
    if (this.drawing && orbit.drawing) this.arrange();
    if (!keep && !wantsLessMotion()) this.clock.play();
  }

  get fixed() {
    return this.orbit?.attrs.fixed ?? this.drawing.fixed;
  }

  arrange() {
    const { drawing, nPoints } = this.orbit;
    const places = Object.values(this.fixed);
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    const take = (x, y) => {
      [x0, x1] = [Math.min(x0, x), Math.max(x1, x)];
      [y0, y1] = [Math.min(y0, y), Math.max(y1, y)];
    };
    for (const [x, y] of places) take(x, y);
    for (let i = 0; i < this.orbit.n * nPoints; i++) take(drawing[2 * i], drawing[2 * i + 1]);
    this.frame.fit(x0, x1, y0, y1, 0.14);
    const trace = this.drawing.points.indexOf(this.drawing.trace);
    this.path = [];
    for (let i = 0; trace >= 0 && i < this.orbit.n; i++) {
      const k = 2 * (i * nPoints + trace);
      this.path.push(drawing[k], drawing[k + 1]);
    }
  }

  paintStill(ctx, frame, colours) {
    if (!this.orbit?.drawing) return;
    ctx.strokeStyle = colourOf(this.orbit, this.view, colours);
    ctx.globalAlpha = 0.75;
    ctx.lineWidth = 1.4;
    ctx.setLineDash(this.orbit.stable === false ? [7, 4] : []);
    if (this.path.length > 2) {
      frame.trace(ctx, [this.path]);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    ctx.globalAlpha = 1;
    const joined = new Set(this.drawing.lines.flat());
    ctx.fillStyle = colours.muted;
    ctx.textAlign = "left";
    ctx.textBaseline = "middle";
    for (const [name, [x, y]] of Object.entries(this.fixed)) {
      const [px, py] = [frame.x(x), frame.y(y)];
      if (joined.has(name)) ctx.fillRect(px - 9, py - 9, 18, 4);
      else {
        ctx.fillRect(px - 7, py - 4, 14, 8);
        ctx.fillText(name, px + 12, py);
      }
    }
  }

  /** Place of a named point now. */
  now(name) {
    const k = this.drawing.points.indexOf(name);
    if (k < 0) return this.fixed[name] ?? null;
    const { drawing, nPoints, time, begin } = this.orbit;
    const [low, high, part] = locate(time, begin + this.clock.time);
    const [a, b] = [2 * (low * nPoints + k), 2 * (high * nPoints + k)];
    return [0, 1].map((i) => drawing[a + i] + part * (drawing[b + i] - drawing[a + i]));
  }

  paintMoving(ctx, frame, colours) {
    if (!this.orbit?.drawing || this.orbit.n < 2) return;
    ctx.strokeStyle = colours.ink;
    ctx.lineWidth = 4;
    for (const line of this.drawing.lines) {
      const places = line.map((name) => this.now(name)).filter(Boolean);
      frame.trace(ctx, [places.flat()]);
      ctx.stroke();
    }
    ctx.lineWidth = 2;
    for (const name of new Set([...this.drawing.points, ...this.drawing.lines.flat()])) {
      const place = this.now(name);
      if (!place) continue;
      const isTraced = name === this.drawing.trace;
      ctx.beginPath();
      ctx.arc(frame.x(place[0]), frame.y(place[1]), isTraced ? 7 : 5, 0, 2 * Math.PI);
      ctx.fillStyle = isTraced ? colourOf(this.orbit, this.view, colours) : colours.card;
      ctx.fill();
      ctx.stroke();
    }
  }

  move() {
    const { clock } = this;
    this.button.textContent = clock.playing ? "Pause" : "Play";
    this.button.disabled = !(clock.duration > 0);
    this.slider.value = clock.duration > 0 ? Math.round((1000 * clock.time) / clock.duration) : 0;
    this.told.textContent = `${clock.time.toFixed(2)} s`;
    this.slider.setAttribute("aria-valuetext", `${clock.time.toFixed(2)} of ${clock.duration.toFixed(2)} seconds`);
    this.frame?.refresh();
  }
}
