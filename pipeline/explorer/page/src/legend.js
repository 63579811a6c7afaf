// What the colours of the diagram mean; each entry switches its points off and on.

import { el, focusedIn } from "./dom.js";
import { onTheme, theme } from "./theme.js";
import { visible } from "./palette.js";

const NONE = { id: -1, label: "other", colour: "#7f7f7f" };

export class Legend {
  constructor(state, view) {
    Object.assign(this, { state, view });
    this.element = el("div", { class: "legend-row", role: "group", "aria-label": "Colours" });
    this.present = null;
    state.on(["colour", "hidden"], () => this.show());
    this.forget = onTheme(() => this.show());
    this.show();
  }

  destroy() {
    this.forget();
  }

  /** Say which categories the diagram has; others are not listed. */
  setPresent(data) {
    this.present = {};
    for (const [name, codes] of Object.entries(data.colours)) {
      const found = new Set();
      if (codes) for (let i = 0; i < codes.length; i++) if (data.first[i + 1] > data.first[i]) found.add(codes[i]);
      this.present[name] = found;
    }
    this.show();
  }

  show() {
    const { colour, hidden } = this.state.get();
    const colouring = this.view.colours.find(({ name }) => name === colour);
    if (!colouring) return this.element.replaceChildren();
    const found = this.present?.[colour];
    const known = new Set(colouring.categories.map(({ id }) => id));
    const entries = colouring.categories.filter(({ id }) => !found || found.has(id));
    if (found && [...found].some((id) => !known.has(id))) entries.push(NONE);
    const off = hidden[colour] ?? [], focused = focusedIn(this.element)?.dataset.id ?? null;
    this.element.replaceChildren(...entries.map((entry) => this.button(entry, off.includes(entry.id))));
    if (focused) this.element.querySelector(`[data-id="${Number(focused)}"]`)?.focus();
  }

  button({ id, label, colour }, isOff) {
    const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = isOff ? "transparent" : visible(colour, theme().card);
    return el("button", {
      type: "button", class: "legend-entry", "data-id": String(id), "aria-pressed": String(!isOff),
      title: isOff ? `Show ${label}` : `Hide ${label}`, on: { click: () => this.toggle(id) },
    }, swatch, label);
  }

  toggle(id) {
    const { colour, hidden } = this.state.get(), off = hidden[colour] ?? [];
    const next = off.includes(id) ? off.filter((other) => other !== id) : [...off, id].sort((a, b) => a - b);
    this.state.set({ hidden: { ...hidden, [colour]: next } });
  }
}
