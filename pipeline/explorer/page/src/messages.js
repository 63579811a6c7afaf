// What the page says: a line for what happens, a banner for what is wrong, both as text alone.

import { el } from "./dom.js";

export class Messages {
  constructor() {
    this.line = el("p", { class: "sr-only", "aria-live": "polite", role: "status" });
    this.banner = el("div", { class: "banner", role: "alert", hidden: true });
    this.facts = el("p", { class: "facts-line" });
    this.progress = el("div", { class: "progress-line", role: "status", hidden: true });
    this.notes = el("div", { class: "notes" });
  }

  /** Tell a reader of the screen what happened. */
  say(text) {
    this.line.textContent = text;
  }

  /** Show what is wrong until it is right again; `again` tries once more. */
  problem(error, again = null) {
    this.banner.hidden = !error;
    this.banner.replaceChildren();
    if (!error) return;
    this.banner.append(el("p", { text: error.message }));
    if (again) this.banner.append(el("button", { type: "button", text: "Try again", on: { click: again } }));
    this.banner.append(el("button", { type: "button", text: "Close", on: { click: () => this.problem(null) } }));
  }

  /** Add a sentence that stays, such as that a run is not complete; `again` looks whether it still holds. */
  note(text, again = null) {
    const button = again && el("button", { type: "button", text: "Look again", on: { click: again } });
    this.notes.append(el("div", { class: "note-line" }, el("p", { text }), button));
  }

  /** Show how far something is; `cancel` ends it. Null takes it away. */
  show(text, share = null, cancel = null) {
    this.progress.hidden = text === null;
    if (text === null) return;
    const bar = el("progress", share === null ? {} : { max: "1", value: String(share) });
    this.progress.replaceChildren(el("span", { text }), ...(share === null && !cancel ? [] : [bar]));
    if (cancel) this.progress.append(el("button", { type: "button", text: "Cancel", on: { click: cancel } }));
    else this.progress.append(el("button", { type: "button", text: "Close", on: { click: () => this.show(null) } }));
  }
}
