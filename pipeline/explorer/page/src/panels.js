// The panels beside the diagram: the orbit behind a point, moving; where starts lead; an orbit that is dragged.

import { card, el, show } from "./dom.js";
import { Clock } from "./clock.js";
import { Follow } from "./follow.js";
import { Machine } from "./machine.js";
import { Multipliers } from "./multipliers.js";
import { NO_LIVE, Plane } from "./plane.js";
import { Orbit } from "./orbit.js";
import { Portraits } from "./portrait.js";
import { saveMenu } from "./save.js";
import { Series } from "./series.js";
import { showFacts } from "./facts.js";
import { Spectrum } from "./spectrum.js";

/** How long a connection may be away before that is said [ms]. */
const PATIENCE_MS = 2000;

/** How often an orbit is asked for again that lacks its multipliers [ms], and how many times. */
const AGAIN_MS = 1500, MOST_ASKED = 60;

class Panels {
  constructor(state, source, element, view) {
    Object.assign(this, { state, source, element, view, live: source.live ?? null, orbit: null, own: null });
    this.clock = new Clock();
    this.asked = 0;
    this.hint = el("p", { class: "hint", role: "status" });
    this.grid = el("div", { class: "panels" });
    this.liveNote = el("p", { class: "hint", role: "status", hidden: true });
    element.replaceChildren(this.hint, this.liveNote, this.grid);
    this.build();
    this.forget = [state.on(["selected"], () => this.select()), state.on(["curvePoint"], () => this.selectOnCurve()), state.on(["eventPoint"], () => this.selectAtEvent())];
    if (this.live) this.forget.push(this.live.on((status) => this.showLive(status)));
    this.select();
  }

  /** Say what stands in the way of computing: a connection that is sought, code that is compiled. */
  showLive({ connected, warming }) {
    clearTimeout(this.lateNote);
    const say = (text) => {
      this.liveNote.textContent = text;
      show(this.liveNote, Boolean(text));
    };
    if (connected) say(warming ? `Compiling what live computing needs: ${warming.done} of ${warming.total} done.` : "");
    else this.lateNote = setTimeout(() => say("Not connected to magpend: nothing can be computed until it answers again."), PATIENCE_MS);
  }

  build() {
    const { view, clock } = this;
    const cards = {
      facts: card("Orbit", "facts"), machine: card(view.model.drawing ? "Motion" : "Time", "machine"),
      portraits: card("Phase portraits", "portraits"), series: card("Over time", "series"),
      multipliers: card("Multipliers", "multipliers"), spectrum: card("Spectrum", "spectrum"), plane: card("Initial states", "plane"), follow: card("Drag a parameter", "follow"),
    };
    const stack = (...names) => el("div", { class: "stack" }, ...names.map((name) => cards[name].element));
    this.grid.append(stack("facts", "machine", "follow"), stack("portraits", "multipliers", "spectrum"), stack("series", "plane"));
    this.cards = cards;
    this.machine = new Machine(cards.machine.body, view, clock);
    this.portraits = new Portraits(cards.portraits.body, view, clock);
    this.series = new Series(cards.series.body, view, clock);
    this.multipliers = new Multipliers(cards.multipliers.body);
    this.spectrum = new Spectrum(cards.spectrum.body, view);
    const starter = this.live && { start: (request, onPiece) => this.start(request, onPiece) };
    this.plane = new Plane(cards.plane.body, view, this.state, this.source, starter);
    if (this.live) this.follow = new Follow(cards.follow.body, view, this.live, { show: (orbit) => this.showFollowed(orbit), back: () => this.back() });
    else cards.follow.body.append(el("p", { class: "note", text: NO_LIVE }));
    this.addMenus();
    this.reveal(false);
  }

  addMenus() {
    const data = { kind: "orbit", query: () => this.state.get().selected }, { source } = this;
    const name = (what) => () => `${this.view.name}-${what}${this.orbit?.attrs.cell ?? ""}`;
    const menus = {
      machine: this.view.model.drawing && { frames: () => [this.machine.frame] },
      portraits: { frames: () => this.portraits.frames, data }, series: { frames: () => this.series.frames, data },
      multipliers: { frames: () => [this.multipliers.frame] }, spectrum: { frames: () => [this.spectrum.frame] },
      plane: { frames: () => [this.plane.frame], data: { kind: "plane", query: () => ({ at: this.plane.indices }) } },
    };
    for (const [key, menu] of Object.entries(menus)) {
      const { element, heading } = this.cards[key];
      if (menu) element.append(saveMenu({ title: heading.textContent, name: name(key), source, ...menu }));
    }
  }

  reveal(isShown) {
    show(this.grid, isShown);
    if (isShown) this.say("");
    else this.say("Click a point of the diagram, or choose one with the keyboard: its orbit is shown here.");
  }

  async select() {
    const { selected } = this.state.get();
    const asked = ++this.asked;
    if (!selected) {
      this.clock.pause();
      this.reveal(false);
      return;
    }
    this.grid.setAttribute("aria-busy", "true");
    if (this.grid.hidden) this.say("Integrating the orbit …");
    let packed;
    try {
      packed = await this.source.orbit(selected);
    } catch (error) {
      if (asked === this.asked) this.say(error.message);
      return;
    } finally {
      if (asked === this.asked) this.grid.removeAttribute("aria-busy");
    }
    if (asked === this.asked) this.showOwn(new Orbit(packed, this.view.model), selected);
  }

  /** Show the orbit at a point of a bifurcation curve. */
  async selectOnCurve() {
    const { curvePoint } = this.state.get();
    if (curvePoint) await this.showLocated(this.source.curveOrbit(curvePoint), `curve-${curvePoint.curve}-${curvePoint.point}`);
    else if (this.grid.dataset.shown?.startsWith("curve-")) await this.select();
  }

  /** Show the orbit at the bifurcation of an event. */
  async selectAtEvent() {
    const { eventPoint } = this.state.get();
    if (eventPoint) await this.showLocated(this.source.eventOrbit(eventPoint), `event-${eventPoint.event}`);
    else if (this.grid.dataset.shown?.startsWith("event-")) await this.select();
  }

  /** Show an orbit that is no cell's, once it is there. */
  async showLocated(coming, name) {
    const asked = ++this.asked;
    this.grid.setAttribute("aria-busy", "true");
    if (this.grid.hidden) this.say("Integrating the orbit …");
    try {
      const packed = await coming;
      if (asked !== this.asked) return;
      this.own = null;
      this.reveal(true);
      this.display(new Orbit(packed, this.view.model), false);
      this.plane.show(this.orbit, true);
      this.grid.dataset.shown = name;
    } catch (error) {
      if (asked === this.asked) this.say(error.message);
    } finally {
      if (asked === this.asked) this.grid.removeAttribute("aria-busy");
    }
  }

  say(text) {
    this.hint.textContent = text;
    show(this.hint, Boolean(text));
  }

  /** Show an orbit of the run. */
  showOwn(orbit, selected) {
    [this.own, this.selected] = [orbit, selected];
    this.reveal(true);
    this.display(orbit, false);
    this.plane.show(orbit);
    this.follow?.show(orbit, selected);
    this.complete(selected, MOST_ASKED);
    this.grid.dataset.shown = `${selected.cell}-${selected.point}`;
  }

  /** Ask again for an orbit whose multipliers the server was still compiling for. */
  complete(selected, left) {
    const { own, asked } = this;
    if (!this.live || !own.attrs.period || own.attrs.multipliers || !own.attrs.note || left === 0) return;
    setTimeout(async () => {
      if (asked !== this.asked || own !== this.own) return;
      const packed = await this.source.orbit(selected).catch(() => null);
      if (!packed || asked !== this.asked || own !== this.own) return;
      const wasShown = this.orbit === own;
      this.own = new Orbit(packed, this.view.model);
      if (wasShown) this.display(this.own, true);
      this.complete(selected, left - 1);
    }, AGAIN_MS);
  }

  /** Show an orbit that has been followed to another value. */
  showFollowed(orbit) {
    this.display(orbit, true);
    this.plane.show(orbit, true);
  }

  back() {
    if (this.own) this.showOwn(this.own, this.selected);
  }

  display(orbit, keepsTime) {
    this.orbit = orbit;
    show(this.cards.follow.element, this.own !== null); // an orbit on a curve belongs to no cell that could be followed
    showFacts(this.cards.facts.body, orbit, this.view);
    this.portraits.show(orbit);
    this.series.show(orbit);
    this.multipliers.show(orbit);
    this.spectrum.show(orbit);
    this.machine.show(orbit, keepsTime);
  }

  /** Integrate a start; its pieces are shown in the portraits, and `onPiece` takes them as well. */
  async start(request, onPiece) {
    this.startJob?.cancel();
    this.portraits.beginLive();
    const job = this.live.job("start", request, (kind, packed) => {
      if (job !== this.startJob || (kind !== "path" && kind !== "sections")) return;
      const piece = new Orbit(packed, this.view.model);
      this.portraits.addLive(kind, piece);
      onPiece(kind, piece);
    });
    this.startJob = job;
    const end = await job.done;
    if (job === this.startJob && end.colour) this.portraits.endLive(end.colour);
    return end;
  }

  destroy() {
    this.asked = -1;
    clearTimeout(this.lateNote);
    this.startJob?.cancel();
    this.clock.pause();
    for (const end of this.forget) end?.();
    for (const part of [this.machine, this.portraits, this.series, this.multipliers, this.spectrum, this.plane, this.follow]) part?.destroy();
    this.element.replaceChildren();
  }
}

/**
 * Put the panels into an element; they follow `state.selected`.
 * @param {Object} state of `createState`
 * @param {Object} source
 * @param {Element} element
 * @param {Object} view
 * @returns {Panels} `destroy()` takes them away
 */
export function mountPanels(state, source, element, view) {
  return new Panels(state, source, element, view);
}
