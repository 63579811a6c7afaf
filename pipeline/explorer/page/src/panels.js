// The panels beside the diagram: the orbit behind a point, moving; where starts lead; an orbit that is dragged.

import { card, el } from "./dom.js";
import { Clock } from "./clock.js";
import { Machine } from "./machine.js";
import { Multipliers } from "./multipliers.js";
import { Orbit } from "./orbit.js";
import { Portraits } from "./portrait.js";
import { Series } from "./series.js";
import { showFacts } from "./facts.js";
import { themeChanged } from "./theme.js";

class Panels {
  constructor(state, source, element, view) {
    [this.state, this.source, this.element, this.view] = [state, source, element, view];
    this.clock = new Clock();
    this.asked = 0;
    this.hint = el("p", { class: "hint", role: "status", text: "Click a point of the diagram: its orbit is shown here." });
    this.grid = el("div", { class: "panels" });
    element.replaceChildren(this.hint, this.grid);
    this.build();
    state.on(["selected"], () => this.select());
    state.on(["dark"], themeChanged);
    this.select();
  }

  build() {
    const { view, clock } = this;
    const facts = card("Orbit", "facts"), machine = card(view.model.drawing ? "Motion" : "Time", "machine");
    const portraits = card("Phase portraits", "portraits"), series = card("Over time", "series");
    const multipliers = card("Multipliers", "multipliers");
    this.orbitCards = [facts, machine, portraits, series, multipliers];
    this.grid.append(...this.orbitCards.map((entry) => entry.element));
    this.factsBody = facts.body;
    this.machine = new Machine(machine.body, view, clock);
    this.portraits = new Portraits(portraits.body, view, clock);
    this.series = new Series(series.body, view, clock);
    this.multipliers = new Multipliers(multipliers.body);
    for (const entry of this.orbitCards) entry.element.hidden = true;
  }

  async select() {
    const { selected } = this.state.get();
    const asked = ++this.asked;
    if (!selected) return;
    try {
      const packed = await this.source.orbit(selected);
      if (asked === this.asked) this.show(new Orbit(packed, this.view));
    } catch (error) {
      if (asked === this.asked) this.say(error.message);
    }
  }

  say(text) {
    this.hint.textContent = text;
    this.hint.hidden = !text;
  }

  /** Show an orbit in all panels; `keep` for one that is followed. */
  show(orbit, keep = false) {
    this.say("");
    for (const entry of this.orbitCards) entry.element.hidden = false;
    this.orbit = orbit;
    showFacts(this.factsBody, orbit, this.view);
    this.portraits.show(orbit);
    this.series.show(orbit);
    this.multipliers.show(orbit);
    this.machine.show(orbit, keep);
  }

  destroy() {
    this.asked = -1;
    this.clock.pause();
    for (const part of [this.machine, this.portraits, this.series, this.multipliers]) part.destroy();
    this.element.replaceChildren();
  }
}

/**
 * Put the panels into an element; they follow `state.selected`.
 * @param {Object} state of `createState`
 * @param {Object} source
 * @param {Element} element
 * @returns {Promise<Panels>} `show(orbit)` shows another orbit, `destroy()` takes them away
 */
export async function mountPanels(state, source, element) {
  return new Panels(state, source, element, await source.view());
}
