// What one chooses above the diagram: axes, values of the other axes, colours, what is drawn over and under it.

import { ONE, atFor } from "./address.js";
import { told } from "./axes.js";
import { el, focusedIn, freshId } from "./dom.js";
import { KEYS } from "./keyboard.js";

function withUnit({ label, unit }) {
  return unit && unit !== "1" ? `${label} [${unit}]` : label;
}

export class Toolbar {
  /** @param {Object} doing what buttons do: zoom(factor), reset(), save(kind, format), region(what) */
  constructor(state, view, formats, doing) {
    Object.assign(this, { state, view, doing, ends: [] });
    this.element = el("div", { class: "toolbar", role: "toolbar", "aria-label": "What the diagram shows" });
    this.help = this.dialog();
    this.fields = el("div", { class: "fields" });
    this.toggles = el("div", { class: "toggles" });
    this.element.append(this.fields, this.toggles, this.buttons(formats));
    state.on(["x", "y", "at", "colour", "overlays"], () => this.show());
    this.show();
  }

  destroy() {
    for (const end of this.ends) end();
  }

  show() {
    const { x, y, at, colour } = this.state.get(), { view, state } = this;
    const fields = [];
    const select = (key, label, options, value, onchange) => options.length > 1 && fields.push(this.select(key, label, options, value, onchange));
    select("y", "Vertical", view.verticals.map((v) => [v.name, withUnit(v)]), y, (name) => state.set({ y: name }));
    select("x", "Horizontal", view.axes.map((a) => [a.name, withUnit(a)]), x, (name) =>
      state.set({ x: name, at: atFor(view, name, at), window: null }));
    for (const axis of view.axes) {
      if (axis.name === x) continue;
      const options = axis.values.map((value, index) => [String(index), `${told(value * axis.factor)} ${axis.unit ?? ""}`.trim()]);
      select(`at.${axis.name}`, axis.label, options, String(at[axis.name] ?? 0), (index) =>
        state.set({ at: { ...state.get().at, [axis.name]: Number(index) } }));
    }
    select("colour", "Colours", [...view.colours.map((c) => [c.name, c.title]), [ONE, "one colour"]], colour, (name) => state.set({ colour: name }));
    const focused = focusedIn(this.fields)?.name;
    this.fields.replaceChildren(...fields);
    if (focused) this.fields.querySelector(`select[name="${CSS.escape(focused)}"]`)?.focus();
    this.showToggles();
  }

  select(name, label, options, value, onchange) {
    const id = freshId("choice"), select = el("select", { id, name, on: { change: () => onchange(select.value) } });
    for (const [key, text] of options) select.append(el("option", { value: key, text }));
    select.value = value;
    return el("span", { class: "field" }, el("label", { for: id, text: label }), select);
  }

  showToggles() {
    const { overlays } = this.state.get(), { has } = this.view;
    const known = [["branches", "Branches", has.branches], ["events", "Events", has.events], ["exponents", "Exponents", this.curves?.has("exponents")], ["fractions", "Fractions", this.curves?.has("fractions")]];
    const entries = known.filter(([, , there]) => there).map(([key, text]) => {
      const id = freshId("toggle");
      const box = el("input", { type: "checkbox", id, name: key, on: { change: () => this.state.set({ overlays: { ...this.state.get().overlays, [key]: box.checked } }) } });
      box.checked = Boolean(overlays[key]);
      return el("span", { class: "toggle" }, box, el("label", { for: id, text }));
    });
    const focused = focusedIn(this.toggles)?.name;
    this.toggles.replaceChildren(...entries);
    if (focused) this.toggles.querySelector(`input[name="${focused}"]`)?.focus();
  }

  buttons(formats) {
    const { doing } = this;
    const button = (text, label, call) => el("button", { type: "button", "aria-label": label, title: label, text, on: { click: call } });
    const pictures = [["Picture (SVG)", () => doing.save("picture", "svg")], ["Picture (PNG)", () => doing.save("picture", "png")]];
    const names = { csv: "CSV", nc: "NetCDF" };
    const data = ["diagram", "curves", "branches"].flatMap((kind) => formats.filter(() => this.offers(kind)).map((format) =>
      [`${{ diagram: "Points", curves: "Curves", branches: "Branches" }[kind]} (${names[format]})`, () => doing.save(kind, format)]));
    const region = [["Download its specification", () => doing.region("download")]];
    if (doing.canRun) region.push(["Run it here", () => doing.region("run")]);
    return el("div", { class: "buttons" },
      button("+", "Zoom in", () => doing.zoom(0.6)), button("−", "Zoom out", () => doing.zoom(1 / 0.6)), button("All", "Show all", () => doing.reset()),
      this.menu("Save", pictures.concat(data)), this.menu("Zoom here", region, "A run of what the window shows, with more points"),
      ...this.absent());
  }

  /** What is not computed yet, with the commands that do. */
  absent() {
    const commands = Object.values(this.view.commands ?? {});
    if (!commands.length) return [];
    const lines = commands.map((command) => el("li", {}, el("code", { text: command })));
    const menu = this.menu("More", [], "Not computed yet; run these, then open the run again:");
    menu.querySelector(".menu-list").append(el("ul", { class: "commands" }, ...lines));
    return [menu];
  }

  offers(kind) {
    const { has } = this.view;
    return kind === "diagram" || (kind === "branches" ? has.branches : has.lyapunov || has.attractors);
  }

  menu(title, entries, hint = null) {
    const list = el("div", { class: "menu-list" }, hint && el("p", { class: "hint", text: hint }), ...entries.map(([text, call]) =>
      el("button", { type: "button", text, on: { click: () => { menu.open = false; call(); } } })));
    const menu = el("details", { class: "menu", on: {
      keydown: (event) => { if (event.key === "Escape") { menu.open = false; menu.querySelector("summary").focus(); } },
      focusout: (event) => { if (event.relatedTarget && !menu.contains(event.relatedTarget)) menu.open = false; },
    } }, el("summary", { text: title }), list);
    const leave = (event) => { if (!event.composedPath().includes(menu)) menu.open = false; };
    document.addEventListener("pointerdown", leave);
    this.ends.push(() => document.removeEventListener("pointerdown", leave));
    return menu;
  }

  dialog() {
    const rows = KEYS.map(([key, text]) => el("div", {}, el("dt", {}, el("kbd", { text: key })), el("dd", { text })));
    const close = el("button", { type: "button", text: "Close", on: { click: () => this.help.close() } });
    return el("dialog", { class: "help", "aria-label": "Keys and gestures" }, el("h2", { text: "Keys and gestures" }), el("dl", {}, ...rows), close);
  }

  /** The button that shows the keys, and what it shows: they stand outside of the toolbar. */
  get helpButton() {
    const button = el("button", { type: "button", "aria-label": "Keys and gestures", title: "Keys and gestures", text: "?", on: { click: () => this.showHelp() } });
    return el("span", {}, button, this.help);
  }

  showHelp() {
    this.help.showModal();
  }
}
