// Events of attractors: marks on the diagram's horizontal axis, and what is known of the chosen one.

import { placeX, told } from "./axes.js";
import { mark } from "./branches.js";
import { card, el, freshId, show } from "./dom.js";

/** Size of a mark, and how far a click may be from one [px]. */
const SIZE = 4.5, REACH = 9;

export class Events {
  /**
   * @param {Object} state of `createState`; buttons set `selected` and `eventPoint`
   * @param {Object} source
   * @param {Object} view
   * @param {Object} diagram whose axis has the marks
   * @param {Object} reader
   */
  constructor(state, source, view, diagram, reader) {
    Object.assign(this, { state, source, view, diagram, reader, list: [], chosen: null });
    const { element, body } = card("Events", "events"), id = freshId("event");
    this.element = element;
    this.choice = el("select", { id, name: "event", on: { change: () => this.choose(this.list[Number(this.choice.value)] ?? null) } });
    this.sentence = el("p", { class: "event-sentence", role: "status" });
    this.buttons = el("div", { class: "buttons" });
    body.append(el("span", { class: "field" }, el("label", { for: id, text: "Event" }), this.choice), this.sentence, this.buttons);
    diagram.events = this;
    this.forget = [state.on(["x", "at"], () => this.load()), state.on(["overlays"], () => this.reveal())];
    show(element, false);
    if (view.has.events) this.load();
  }

  destroy() {
    this.forget.forEach((end) => end());
  }

  /** The events that are drawn. */
  get shown() {
    return this.state.get().overlays.events ? this.list : [];
  }

  async load() {
    if (!this.view.has.events) return;
    const { x, at } = this.state.get(), asked = (this.asked = JSON.stringify([x, at]));
    try {
      const found = await this.source.events({ x, at });
      if (asked === this.asked) this.take(found.events);
    } catch (error) {
      this.reader.say(error.message);
    }
  }

  take(list) {
    this.list = list;
    const axis = this.diagram.horizontal, { factor = 1 } = axis ?? {};
    const where = ({ x, low, high }) => (x === null ? `${told(low * factor, 0)} to ${told(high * factor, 0)}` : told(x * factor, 0));
    this.choice.replaceChildren(el("option", { value: "", text: `${list.length} along ${axis?.label ?? ""}` }),
      ...list.map((event, k) => el("option", { value: String(k), text: `${event.label} at ${where(event)}: ${event.sentence.split(" ", 1)[0]}` })));
    this.choose(null);
    this.reveal();
  }

  reveal() {
    show(this.element, this.shown.length > 0);
    this.diagram.repaint();
  }

  /** Show an event: its sentence, and buttons for the orbits before, at and after it. */
  choose(event) {
    this.chosen = event;
    this.choice.value = event ? String(this.list.indexOf(event)) : "";
    this.sentence.textContent = event ? event.sentence : "Click a mark on the axis, or choose an event.";
    const { x, at } = this.state.get();
    const cell = (number) => () => this.state.set({ eventPoint: null, selected: { cell: number, point: this.diagram.skipped } });
    const entries = event ? [
      [event.before !== null, "Before", "The orbit at the last value with cells", cell(event.before)],
      [event.orbit && Boolean(this.source.eventOrbit), "At the event", "The orbit at the bifurcation", () => {
        this.state.set({ eventPoint: null });
        this.state.set({ eventPoint: { x, at, event: event.event } });
      }],
      [event.after !== null, "After", "The orbit from the same start at the next value", cell(event.after)],
    ] : [];
    this.buttons.replaceChildren(...entries.filter(([there]) => there).map(([, text, title, call]) =>
      el("button", { type: "button", title, text, on: { click: call } })));
    this.diagram.repaint();
    if (event) this.reader.say(event.sentence);
  }

  // ---- on the axis -------------------------------------------------------------------------

  /** Paint the marks; an event that is not decided is a bar between its two values. */
  paint(ctx, box, bounds, colours) {
    const y = box.top + box.height;
    for (const event of this.shown) {
      const [a, b] = this.span(box, bounds, event);
      if (b < box.left || a > box.left + box.width) continue;
      const colour = event === this.chosen ? colours.accent : colours.ink;
      ctx.strokeStyle = colour;
      ctx.fillStyle = event === this.chosen ? colours.accent : colours.card;
      ctx.lineWidth = event.x === null ? 3 : 1.5;
      if (event.x === null) {
        ctx.beginPath();
        ctx.moveTo(Math.max(a, box.left), y);
        ctx.lineTo(Math.min(b, box.left + box.width), y);
      } else {
        mark(ctx, "triangle", a, y, SIZE);
        ctx.fill();
      }
      ctx.stroke();
    }
  }

  span(box, bounds, { x, low, high }) {
    return x === null ? [placeX(box, bounds, low), placeX(box, bounds, high)] : [placeX(box, bounds, x), placeX(box, bounds, x)];
  }

  /** The event whose mark is at a place; the next one of several there follows the chosen one. */
  at(box, bounds, px, py) {
    if (Math.abs(py - box.top - box.height) > REACH) return null;
    const away = (event) => {
      const [a, b] = this.span(box, bounds, event);
      return Math.max(a - px, px - b, 0);
    };
    const here = this.shown.filter((event) => away(event) <= REACH).sort((one, other) => away(one) - away(other));
    return here[(here.indexOf(this.chosen) + 1) % here.length] ?? null;
  }
}
