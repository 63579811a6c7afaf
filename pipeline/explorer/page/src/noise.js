// Noise on a live start: how strong, with which seed, and what is told of a noisy motion.

import { el, freshId, numberField, show } from "./dom.js";
import { number } from "./facts.js";

/** Strongest noise of the slider [scales of the rates over the square root of a second], and its step. */
const MOST = 0.5, STEP = 0.005;

export class Noise {
  /**
   * @param {Object} view
   * @param {function(string): string} named what a state is called
   */
  constructor(view, named) {
    [this.strength, this.seed] = [0, 0];
    const rates = view.model.states.map((state) => state.rate).filter(Boolean);
    this.on = (rates.length ? rates : view.model.states.map((state) => state.name)).map(named).join(", ");
    const id = freshId("noise");
    const slider = el("input", { id, type: "range", min: 0, max: MOST, step: STEP, value: 0, on: { input: () => this.set(slider.valueAsNumber) } });
    this.told = el("output", { class: "told", for: id });
    this.seeds = numberField("Seed", 0, (value) => (this.seed = Math.min(Number.MAX_SAFE_INTEGER, Math.max(0, Math.round(value)))));
    this.element = el("div", { class: "controls" }, el("span", { class: "field grow" }, el("label", { for: id, text: `Noise on ${this.on}` }), slider, this.told), this.seeds);
    show(this.element, view.model.forced); // a noisy state crosses a section infinitely often
    this.set(0);
  }

  set(strength) {
    this.strength = strength;
    this.told.textContent = strength ? `${number(strength)} /√s` : "none";
    show(this.seeds, strength > 0);
  }

  /** Fields of a request for a start. */
  get request() {
    return this.strength ? { noise: this.strength, seed: this.seed } : {};
  }

  /** What is told of the end of a noisy motion: that it is noisy, and where no attractor is told. */
  sentence({ noise, seed, periods, status }) {
    const end = status === "diverged" ? `It diverged after ${periods} periods.` : `Its section points of ${periods} periods are shown. With noise no motion settles, so no attractor is named.`;
    return `Noisy: strength ${number(noise)} of the scales per √s on ${this.on}, seed ${seed}. ${end}`;
  }
}
