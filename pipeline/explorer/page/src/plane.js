// The plane of initial states at a parameter value: where its starts lead, as far as that is computed. A slice
// is computed while one watches; a click integrates that start.

import { el, labelledSelect, numberField, shortened, show } from "./dom.js";
import { Frame } from "./frame.js";
import { number } from "./facts.js";
import { Noise } from "./noise.js";
import { axisOf, indicesOf } from "./orbit.js";
import { idAt, imageOf, mapOf } from "./plane-map.js";
import { Push } from "./push.js";
import { brokenLines } from "./wrapping.js";

const MOST_KEPT = 12;
const RESOLUTIONS = [64, 128, 256, 512], COARSEST = 16;
const TURN = 2 * Math.PI;
export const NO_LIVE = "Live integration is off in this copy: open the run with magpend explore to integrate starts, compute slices and drag parameters.";

export class Plane {
  /**
   * @param {Element} body
   * @param {Object} view
   * @param {Object} state of `createState`
   * @param {Object} source
   * @param {{start: function(Object, function): Promise<Object>}|null} starter integrates a start; null without a server
   */
  constructor(body, view, state, source, starter) {
    Object.assign(this, { view, state, source, starter, live: source.live, orbit: null, map: null, job: null });
    this.asked = 0;
    this.kept = new Map();
    this.cross = null;
    [this.paths, this.dots, this.end] = [[], [], null];
    this.pairs = view.planes?.length ? view.planes : [view.model.states.slice(0, 2).map((entry) => entry.name)];
    this.pair = this.chosenPair();
    this.build(body);
    this.forget = [state.on(["plane"], () => this.choose(this.chosenPair()))];
  }

  destroy() {
    this.job?.cancel();
    for (const end of this.forget) end();
    this.frame.destroy();
  }

  chosenPair() {
    const wanted = this.state.get().plane?.states;
    return this.pairs.find((pair) => wanted && pair[0] === wanted[0] && pair[1] === wanted[1]) ?? this.pairs[0];
  }

  // ---- what stands on the page -------------------------------------------------------------

  build(body) {
    this.body = body;
    this.readout = el("output", { class: "readout" });
    this.legend = el("ul", { class: "legend" });
    this.told = el("p", { class: "note", role: "status" });
    const options = this.pairs.map((pair, k) => [String(k), `${this.named(pair[1])} against ${this.named(pair[0])}`]);
    this.chooser = labelledSelect("Plane", options, String(this.pairs.indexOf(this.pair)), (k) => this.state.set({ plane: { states: this.pairs[k] } }));
    body.append(el("div", { class: "controls top" }, this.chooser.element));
    show(this.chooser.element, this.pairs.length > 1);
    this.frame = new Frame(body, { label: "", ratio: 0.8 });
    this.frame.paintBack = (ctx, frame, colours) => this.paint(ctx, frame, colours);
    this.frame.paintFront = (ctx, frame, colours) => this.paintCross(ctx, frame, colours);
    this.push = new Push(this);
    body.append(this.readout, this.legend, this.told);
    this.listen();
    if (this.live) this.buildLive(body);
    else body.append(el("p", { class: "note", text: NO_LIVE }));
    body.append(this.push.element);
    this.dress();
  }

  buildLive(body) {
    this.resolution = labelledSelect("Cells", RESOLUTIONS.map((n) => [String(n), `${n} × ${n}`]), "128", () => {});
    this.compute = el("button", { type: "button", text: "Compute this slice", on: { click: () => this.slice() } });
    this.stop = el("button", { type: "button", text: "Cancel", hidden: true, on: { click: () => this.job?.cancel() } });
    this.progress = el("progress", { max: 1, value: 0, hidden: true, "aria-label": "Slice" });
    this.bounds = el("div", { class: "bounds" });
    this.startFields = el("span", { class: "starts" });
    const begin = el("button", { type: "button", text: "Integrate this start", on: { click: () => this.begin(this.cross ?? this.middle) } });
    this.noise = new Noise(this.view, (name) => this.named(name));
    body.append(el("div", { class: "controls" }, this.startFields, begin), this.noise.element);
    const more = el("details", {}, el("summary", { text: "Bounds, and the other states" }), this.bounds);
    body.append(el("div", { class: "controls" }, this.compute, this.resolution.element, this.stop), this.progress, more);
  }

  named(name) {
    const found = this.view.model.states.find((entry) => entry.name === name);
    return found?.label || name;
  }

  dress() {
    this.frame.xAxis = axisOf(this.view.model, this.pair[0]);
    this.frame.yAxis = axisOf(this.view.model, this.pair[1]);
    const what = `Plane of initial states: ${this.named(this.pair[1])} against ${this.named(this.pair[0])}`;
    this.frame.setLabel(this.live ? `${what}. Arrow keys move a cross, Enter integrates the start there.` : what);
  }

  // ---- which plane -------------------------------------------------------------------------

  choose(pair) {
    this.pair = pair;
    this.chooser.select.value = String(this.pairs.indexOf(pair));
    this.dress();
    if (this.orbit) this.show(this.orbit, this.isFollowed);
  }

  /** Show the plane at the parameter values of an orbit; one that is followed has none in the run. */
  async show(orbit, isFollowed = false) {
    const asked = ++this.asked;
    [this.orbit, this.isFollowed] = [orbit, isFollowed];
    const place = JSON.stringify([orbit.attrs.parameters, orbit.attrs.frequency, this.pair]);
    const isSame = place === this.place;
    this.push.show(orbit, isFollowed);
    if (isSame) return;
    this.place = place;
    this.job?.cancel();
    this.cross = null;
    this.forgetStart();
    const kept = this.kept.get(place);
    this.take(kept?.map ?? null);
    if (kept) [this.image, this.below, this.fixed] = [kept.image, kept.below, kept.map.fixed];
    if (kept || isFollowed) return;
    let map = null, problem = "";
    try {
      map = mapOf(await this.source.plane({ at: indicesOf(orbit, this.view) }));
    } catch (error) {
      problem = error.message;
    }
    if (asked !== this.asked) return;
    const fits = map && map.states.join() === this.pair.join();
    this.take(fits ? map : null, problem);
  }

  take(map, problem = "") {
    [this.map, this.below] = [map, null];
    this.limits = map?.box ?? this.usualLimits();
    this.frame.fit(...this.limits, 0);
    this.fixed = this.usualFixed();
    if (this.live) this.fillBounds();
    this.image = map?.label ? imageOf(map) : null;
    this.showLegend();
    const missing = `Where starts of this plane lead is not computed here${this.live ? "" : "."}${this.live ? ": compute the slice, or click a start." : ""}`;
    this.told.textContent = problem || (map ? sourceSentence(map) : missing);
    this.frame.repaint();
  }

  usualLimits() {
    return this.pair.flatMap((name) => {
      const state = this.view.model.states.find((entry) => entry.name === name);
      if (state?.angle) return [-Math.PI, Math.PI];
      const values = this.orbit ? [...this.orbit.column(name), ...this.orbit.section(name)] : [0];
      const low = Math.min(...values), high = Math.max(...values), middle = (low + high) / 2;
      const half = Math.max(high - low, 0.5 * (state?.scale ?? 1)) * 0.9;
      return [middle - half, middle + half];
    });
  }

  usualFixed() {
    const fixed = {};
    for (const { name } of this.view.model.states) {
      if (this.pair.includes(name)) continue;
      const section = this.orbit?.section(name);
      fixed[name] = this.map?.fixed?.[name] ?? (this.view.model.forced ? 0 : section?.[0] ?? 0);
    }
    return fixed;
  }

  get middle() {
    const [x0, x1, y0, y1] = this.limits;
    return [(x0 + x1) / 2, (y0 + y1) / 2];
  }

  /** Fields of the start that is integrated next: where the cross is. */
  fillStart() {
    const place = this.cross ?? this.middle;
    const fields = this.pair.map((name, k) => numberField(`Start ${this.named(name)}`, place[k], (value) => {
      const other = this.cross ?? this.middle;
      this.putCross(k ? [other[0], value] : [value, other[1]]);
    }));
    this.startFields.replaceChildren(...fields);
  }

  putCross(place) {
    this.cross = place;
    this.read(place);
    this.startFields.querySelectorAll("input").forEach((input, k) => {
      if (input.valueAsNumber !== place[k]) input.value = shortened(place[k]);
    });
    this.frame.refresh();
  }

  fillBounds() {
    this.fillStart();
    const bound = (k) => (value) => {
      const limits = [...this.limits];
      limits[k] = value;
      if (limits[0] < limits[1] && limits[2] < limits[3]) this.frame.fit(...(this.limits = limits), 0);
    };
    const words = ["from", "to"];
    const fields = this.limits.map((value, k) => numberField(`${this.named(this.pair[k >> 1])} ${words[k % 2]}`, value, bound(k)));
    for (const [name, value] of Object.entries(this.fixed)) fields.push(numberField(this.named(name), value, (given) => (this.fixed[name] = given)));
    this.bounds.replaceChildren(...fields);
  }

  // ---- painting ----------------------------------------------------------------------------

  paint(ctx, frame, colours) {
    if (this.image) {
      const [x0, x1, y0, y1] = this.map.box;
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(this.image, frame.x(x0), frame.y(y1), frame.x(x1) - frame.x(x0), frame.y(y0) - frame.y(y1));
    } else if (this.map?.dots) this.paintStarts(ctx, frame, colours);
    for (const [k, width, colour] of [[0, 2.6, colours.card], [0, 1.2, colours.ink], [1, 3.6, colours.card], [1, 1.8, colours.ink]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      // what comes after the first periods is fainter: the plane below is to be seen
      ctx.globalAlpha = k ? 1 : 0.35;
      frame.trace(ctx, this.paths[k] ?? []);
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
    this.push.paint(ctx, frame, colours);
    ctx.strokeStyle = colours.card;
    ctx.lineWidth = 1;
    for (const [x, y] of this.dots) {
      ctx.beginPath();
      ctx.arc(frame.x(x), frame.y(y), 3, 0, TURN);
      ctx.fillStyle = this.end ?? colours.ink;
      ctx.fill();
      ctx.stroke();
    }
  }

  paintStarts(ctx, frame, colours) {
    const { u, v, dots } = this.map;
    dots.forEach((id, i) => {
      ctx.beginPath();
      ctx.arc(frame.x(u[i]), frame.y(v[i]), 5, 0, TURN);
      ctx.fillStyle = this.colourOf(id) ?? colours.card;
      ctx.strokeStyle = colours.ink;
      ctx.lineWidth = 1;
      ctx.fill();
      ctx.stroke();
    });
  }

  colourOf(id) {
    return this.map.labels.find((entry) => entry.id === id)?.colour ?? null;
  }

  paintCross(ctx, frame, colours) {
    this.push.paintFront(ctx, frame, colours);
    if (!this.cross || this.push.isOn) return;
    const [px, py] = [frame.x(this.cross[0]), frame.y(this.cross[1])];
    for (const [width, colour] of [[4, colours.card], [2, colours.ink]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        ctx.moveTo(px + 3 * dx, py + 3 * dy);
        ctx.lineTo(px + 11 * dx, py + 11 * dy);
      }
      ctx.stroke();
    }
  }

  showLegend() {
    if (!this.map) return this.legend.replaceChildren();
    const counts = new Map();
    for (const id of this.map.label ?? this.map.dots) if (id >= 0) counts.set(id, (counts.get(id) ?? 0) + 1);
    const total = [...counts.values()].reduce((a, b) => a + b, 0);
    const items = this.map.labels.filter((entry) => counts.has(entry.id)).map((entry) => {
      const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = entry.colour;
      return el("li", {}, swatch, `${entry.label} (${((100 * counts.get(entry.id)) / total).toFixed(1)} %)`);
    });
    return this.legend.replaceChildren(...items);
  }

  // ---- pointing ----------------------------------------------------------------------------

  listen() {
    const { front } = this.frame;
    this.frame.element.classList.add("takes-pointer");
    front.addEventListener("pointermove", (event) => this.read(this.frame.at(event)));
    if (!this.live) return;
    front.tabIndex = 0;
    front.setAttribute("role", "application");
    front.addEventListener("click", (event) => {
      const place = this.push.isOn ? null : this.frame.at(event);
      if (place) this.begin(place);
    });
    this.push.listen(front);
    front.addEventListener("keydown", (event) => this.key(event));
    front.addEventListener("focus", () => this.moveCross(0, 0));
  }

  key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.key in steps) {
      const [dx, dy] = steps[event.key].map((step) => step * (event.shiftKey ? 10 : 1));
      if (this.push.isOn) this.push.nudge(dx, dy);
      else this.moveCross(dx, dy);
    } else if (event.key === "Enter" || event.key === " ") this.push.isOn ? this.push.go() : this.begin(this.cross);
    else return;
    event.preventDefault();
  }

  moveCross(dx, dy) {
    if (!this.frame.limits) return;
    const [x0, x1, y0, y1] = this.limits, [x, y] = this.cross ?? this.middle;
    const held = (value, low, high) => Math.min(high, Math.max(low, value));
    this.putCross([held(x + (dx * (x1 - x0)) / 100, x0, x1), held(y + (dy * (y1 - y0)) / 100, y0, y1)]);
  }

  read(place) {
    if (!place) return;
    const [x, y] = place.map((value) => number(value));
    const label = this.labelAt(place);
    this.readout.textContent = `${this.named(this.pair[0])} = ${x}, ${this.named(this.pair[1])} = ${y}${label ? `: ${label}` : ""}`;
  }

  labelAt([x, y]) {
    if (!this.map?.label) return "";
    const id = idAt(this.map, x, y) ?? -1;
    return this.map.labels.find((entry) => entry.id === (id < 0 && this.below ? idAt(this.below, x, y) : id))?.label ?? "";
  }

  // ---- computing ---------------------------------------------------------------------------

  /** Indices of the axes at the orbit's parameter values, for what is kept of this plane. */
  get indices() {
    return this.orbit ? indicesOf(this.orbit, this.view) : {};
  }

  get point() {
    return { parameters: this.orbit.attrs.parameters ?? {}, frequency: this.orbit.attrs.frequency ?? null };
  }

  /** Integrate the start at a place of the plane. */
  async begin(place) {
    if (!place || !this.orbit) return;
    this.putCross(place);
    await this.integrate({ ...this.fixed, [this.pair[0]]: place[0], [this.pair[1]]: place[1] }, endSentence);
  }

  /** Integrate a state; `sentence` says of its end what is told. */
  async integrate(state, sentence) {
    this.forgetStart();
    const { request } = this.noise;
    this.told.classList.toggle("lost", Boolean(request.noise));
    this.told.textContent = request.noise ? "Integrating with noise: the first time, code is compiled for some seconds ..." : "Integrating this start ...";
    const begun = (this.begun = {});
    try {
      const end = await this.starter.start({ ...this.point, ...request, state }, (kind, piece) => begun === this.begun && this.add(kind, piece));
      if (begun !== this.begun || end.cancelled) return;
      this.told.textContent = end.noise ? this.noise.sentence(end) : sentence(end);
      this.end = end.colour;
      this.frame.repaint();
    } catch (error) {
      if (begun === this.begun) this.told.textContent = error.message;
    }
  }

  forgetStart() {
    this.begun = null;
    this.told.classList.remove("lost");
    [this.paths, this.dots, this.end] = [[], [], null];
    this.frame.repaint();
  }

  /** Show a piece of a start that is being integrated. */
  add(kind, piece) {
    const [x, y] = this.pair.map((name, k) => this.around(kind === "path" ? piece.column(name) : piece.section(name), k));
    if (kind === "path") {
      const lines = brokenLines(x.values, y.values, x.wrapping, y.wrapping);
      const part = this.paths.length ? 0 : 1;
      this.paths[part] ??= [];
      this.paths[part].push(...lines.map((line) => line.map((value, i) => value + (i % 2 ? y.middle : x.middle))));
    } else {
      const back = (value, { wrapping, middle }) => (wrapping.cut ? value - TURN * Math.floor((value + Math.PI) / TURN) : value) + middle;
      for (let i = 0; i < x.values.length; i++) this.dots.push([back(x.values[i], x), back(y.values[i], y)]);
      this.dots = this.dots.slice(-300);
    }
    this.frame.repaint();
  }

  /** Values of a plane's state from the middle of what is shown of it; of an angle, within half a turn. */
  around(values, side) {
    const { angle } = side ? this.frame.yAxis : this.frame.xAxis;
    const middle = angle ? (this.limits[2 * side] + this.limits[2 * side + 1]) / 2 : 0;
    return { values: values.map((value) => value - middle), wrapping: { shift: 0, cut: angle }, middle };
  }

  /** Compute the slice, low resolution first. */
  async slice() {
    if (!this.orbit) return;
    const limits = this.limits, [x0, x1, y0, y1] = limits, resolution = Number(this.resolution.select.value);
    const request = { ...this.point, plane: this.pair, ranges: [[x0, x1], [y0, y1]], fixed: this.fixed, resolution };
    this.job?.cancel();
    this.forgetStart();
    this.working(true);
    this.told.textContent = "Computing ...";
    this.below = null;
    const job = (this.job = this.live.job("slice", request, (kind, piece) => job === this.job && this.refine(kind, piece, resolution)));
    try {
      const end = await job.done;
      if (job === this.job) this.told.textContent = end.cancelled ? "Cancelled; what was computed stays." : `Computed: ${resolution} × ${resolution} starts.`;
    } catch (error) {
      if (job === this.job) this.told.textContent = error.message;
    }
    if (job === this.job) this.working(false);
  }

  /** Keep the slice for when one comes back to this parameter value. */
  keep() {
    this.kept.delete(this.place);
    this.kept.set(this.place, { map: this.map, image: this.image, below: this.below });
    if (this.kept.size > MOST_KEPT) this.kept.delete(this.kept.keys().next().value);
  }

  working(isWorking) {
    if (!isWorking) this.job = null;
    show(this.stop, isWorking);
    show(this.progress, isWorking);
    this.compute.disabled = isWorking;
    if (isWorking) this.progress.removeAttribute("value");
  }

  refine(kind, piece, wanted) {
    if (kind !== "slice") return;
    const { resolution, share_done: share } = piece.attrs, before = resolution > COARSEST ? (resolution / 2) ** 2 : 0;
    this.progress.value = (before + share * (resolution ** 2 - before)) / wanted ** 2;
    this.map = mapOf({ ...piece, attrs: { ...piece.attrs, states: this.pair, fixed: this.fixed, source: "slice" } }, this.limits);
    this.image = imageOf(this.map, this.below?.image);
    if (share >= 1) {
      this.below = { ...this.map, image: this.image };
      this.keep();
    }
    this.showLegend();
    if (resolution < wanted) this.told.textContent = `${resolution} × ${resolution} of ${wanted} × ${wanted} starts`;
    this.frame.repaint();
  }
}

function sourceSentence({ source, fixed, u, v, dots }) {
  const held = Object.entries(fixed).map(([name, value]) => `${name} = ${number(value)}`).join(", ");
  const known = { slice: `A computed slice of ${u.length} × ${v.length} starts`, basins: "Basins of attraction", starts: `The run's ${u.length} × ${v.length} starts` };
  const what = dots ? `The run's ${dots.length} starts` : known[source] ?? source;
  return held ? `${what}, at ${held}.` : `${what}.`;
}

function endSentence({ label, motion, status, periods, period }) {
  const what = label ?? [period ? `period ${period}` : status, motion].filter(Boolean).join(", ");
  return `This start ends on ${what}${periods ? `, after ${periods} periods` : ""}.`;
}
