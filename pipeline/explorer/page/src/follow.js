// An orbit that is dragged along a parameter: it follows by continuation, or is lost.

import { el, focusedIn, freshId, labelledSelect } from "./dom.js";
import { number } from "./facts.js";
import { Orbit, withUnit } from "./orbit.js";

const STEPS = 1000, FREQUENCY = "frequency";

/** Whether an axis is that of a parameter, or of the drive's frequency. */
function isOf(axis, name) {
  return axis.name === name || axis.parameter === name;
}

export class Follow {
  /**
   * @param {Element} body
   * @param {Object} view
   * @param {Object} live
   * @param {{show: function(Orbit): void, back: function(): void}} panels shows a followed orbit, or the run's own again
   */
  constructor(body, view, live, panels) {
    Object.assign(this, { view, live, panels, orbit: null, from: null, wanted: null, busy: false });
    this.choices = this.parameters();
    const first = view.axes.find((axis) => axis.path) ?? view.axes[0];
    this.parameter = this.choices.find((entry) => first && isOf(first, entry.name)) ?? this.choices[0];
    this.build(body);
  }

  destroy() {
    this.job?.cancel();
  }

  parameters() {
    const found = this.view.model.parameters.map((entry) => ({ ...entry, text: withUnit(entry) }));
    if (this.view.model.forced) found.unshift({ name: FREQUENCY, label: "frequency", unit: "Hz", text: "frequency [Hz]" });
    return found;
  }

  build(body) {
    const options = this.choices.map((entry) => [entry.name, entry.text]);
    this.chooser = labelledSelect("Parameter", options, this.parameter.name, (name) => this.choose(name));
    const [sliderId, inputId] = [freshId("slider"), freshId("value")];
    this.slider = el("input", { id: sliderId, type: "range", min: 0, max: STEPS, step: 1, on: { input: () => this.drag() } });
    this.input = el("input", { id: inputId, type: "number", step: "any", on: { change: () => this.ask(this.input.valueAsNumber) } });
    this.back = el("button", { type: "button", text: "Back to the run's orbit", disabled: true, on: { click: () => this.panels.back() } });
    this.told = el("p", { class: "note", role: "status" });
    body.append(
      el("div", { class: "controls top" }, this.chooser.element),
      el("div", { class: "controls" }, el("span", { class: "field grow" }, el("label", { for: sliderId, text: "Drag" }), this.slider)),
      el("div", { class: "controls" }, el("span", { class: "field" }, el("label", { for: inputId, text: "Value" }), this.input), this.back),
      this.told,
    );
  }

  /** Begin at an orbit of the run. */
  show(orbit, selected) {
    this.job?.cancel();
    [this.orbit, this.origin, this.from, this.wanted] = [orbit, orbit, selected, null];
    this.back.disabled = true;
    this.tell(orbit.attrs.period ? "Drag: the orbit follows by continuation." : "This motion is not periodic: no orbit of it can be followed.");
    for (const control of [this.slider, this.input]) control.disabled = !orbit.attrs.period;
    this.arrange();
  }

  choose(name) {
    this.parameter = this.choices.find((entry) => entry.name === name);
    this.arrange();
  }

  valueOf(orbit) {
    return (this.parameter.name === FREQUENCY ? orbit.attrs.frequency : orbit.attrs.parameters?.[this.parameter.name]) ?? this.parameter.value;
  }

  /** Bounds of the slider: what the run sweeps, or what the view proposes; else a third to either side. */
  arrange() {
    const value = this.valueOf(this.orbit), { name, low, high } = this.parameter;
    const axis = this.view.axes.find((entry) => isOf(entry, name));
    const reach = Math.abs(value) / 3 || 1;
    [this.low, this.high] = [value - reach, value + reach];
    if (axis?.values.length > 1) [this.low, this.high] = [Math.min(...axis.values), Math.max(...axis.values)];
    else if (low < value && value < high) [this.low, this.high] = [low, high];
    this.mark(value);
  }

  mark(value) {
    this.slider.value = Math.round((STEPS * (value - this.low)) / (this.high - this.low || 1));
    this.input.value = Number(value.toPrecision(8));
    this.slider.setAttribute("aria-valuetext", `${this.parameter.text}: ${number(value, 6)}`);
  }

  drag() {
    const value = this.low + (this.slider.value / STEPS) * (this.high - this.low);
    this.input.value = Number(value.toPrecision(6));
    this.ask(value);
  }

  /** Follow to a value; of several that are asked while one is at work, the last. */
  ask(value) {
    if (!Number.isFinite(value) || !this.from) return;
    this.wanted = value;
    if (!this.busy) this.work();
  }

  async work() {
    this.busy = true;
    while (this.wanted !== null) {
      const [value, from, parameter] = [this.wanted, this.from, this.parameter.name];
      this.wanted = null;
      let piece = null;
      this.job = this.live.job("follow", { from, parameter, value }, (kind, found) => kind === "orbit" && (piece = found));
      try {
        const end = await this.job.done;
        if (from === this.from && !end.cancelled) this.take(piece);
      } catch (error) {
        if (from === this.from) this.tell(error.message, true);
      }
    }
    this.busy = false;
  }

  take(piece) {
    const attrs = piece?.attrs;
    if (!piece?.arrays.time) return;
    const orbit = new Orbit(piece, this.view.model);
    this.orbit = orbit;
    if (attrs.orbit !== undefined && attrs.orbit !== null) this.from = { orbit: attrs.orbit };
    this.back.disabled = false;
    const stability = { true: "stable", false: "unstable" }[String(orbit.stable)] ?? "of unknown stability";
    const place = number(attrs.value ?? this.valueOf(orbit), 6);
    if (attrs.lost) this.tell(`Lost: ${attrs.sentence ?? `there is no orbit beyond ${place}`}`, true);
    else if (attrs.sentence) this.tell(attrs.sentence);
    else this.tell(`Followed to ${this.parameter.text} = ${place}: ${stability}.`);
    if (this.wanted === null && !focusedIn(this.slider)) this.mark(this.valueOf(orbit));
    this.panels.show(orbit);
  }

  tell(text, isLost = false) {
    this.told.textContent = text;
    this.told.classList.toggle("lost", isLost);
  }
}
