// The atlas of a plane of two parameters: regions, lines of further ends, and changes that are not explained.

import { el, labelledSelect } from "./dom.js";
import { number } from "./facts.js";

/** Half the width of a cross [px], and how far a click may be from one. */
const CROSS = 4, REACH = 8;

export class Atlas {
  /**
   * @param {Object} found regions, lines, marks and grid, as `parameter-plane` has them
   * @param {Object} plane the `ParameterPlane`: its frame, source, state and diagram
   */
  constructor(found, plane) {
    Object.assign(this, found, { plane, chosen: null });
    const options = [["", "Choose a region or a change"],
      ...this.regions.map(({ label }, k) => [`region:${k}`, `Region ${k}: ${label}`]), ...this.marks.map(({ text }, k) => [`mark:${k}`, text])];
    const { element, select } = labelledSelect("Atlas", options, "", (value) => {
      const [kind, k] = value.split(":");
      if (kind) this.choose({ [kind]: Number(k) });
    });
    this.select = select;
    this.told = el("div", { class: "atlas-told", role: "status" });
    this.element = el("div", { class: "atlas" }, element, this.told);
  }

  get outlines() {
    return this.regions.flatMap(({ rings }) => rings);
  }

  /** Entries of the legend: the tint of each kind of region, the largest areas first. */
  get legend() {
    const shades = new Map(), list = [];
    for (const { label, colour } of this.regions) if (!shades.has(label)) shades.set(label, colour);
    for (const [label, colour] of shades) {
      const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = colour;
      list.push(el("li", {}, swatch, label));
    }
    const kinds = [...new Set(this.lines.map(({ kind }) => kind))];
    if (kinds.length) list.push(el("li", { text: `┈ ends on no curve: ${kinds.join(", ")}` }));
    if (this.marks.length) list.push(el("li", { text: `✕ not explained: ${this.marks.length}` }));
    return list;
  }

  // ---- pointing ----------------------------------------------------------------------------

  /** The mark near a place [px], or null. */
  markAt(px, py) {
    let best = null, least = REACH;
    this.marks.forEach(({ x, y }, mark) => {
      const away = Math.hypot(px - this.plane.frame.x(x), py - this.plane.frame.y(y));
      if (away < least) [best, least] = [{ mark }, away];
    });
    return best;
  }

  /** The region at values of both parameters, or null. */
  regionAt(place) {
    const region = this.regions.findIndex(({ rings }) => rings.reduce((odd, ring) => odd !== holds(ring, place), false));
    return region < 0 ? null : { region, place };
  }

  /** What a hit is, in words. */
  text({ mark, line, region }) {
    if (mark !== undefined) return this.marks[mark].text;
    if (line !== undefined) return `${this.lines[line].kind}, on no curve`;
    return `Region ${region}: ${this.regions[region].label}`;
  }

  choose(hit) {
    this.chosen = hit;
    this.select.value = hit.mark === undefined ? `region:${hit.region}` : `mark:${hit.mark}`;
    this.plane.frame.refresh();
    if (hit.mark === undefined) return this.tellRegion(hit);
    const { text, why, cells } = this.marks[hit.mark];
    const parts = [el("p", { text: `${text[0].toUpperCase()}${text.slice(1)}.` }), el("p", { text: `${why[0].toUpperCase()}${why.slice(1)}.` })];
    if (cells.length) this.tell(parts, cells.map(({ text: side, at, cell }) => [`${this.words(at)}, ${side}`, at, cell]));
    else this.tell([...parts, el("p", { text: "These points were run beside the run: it has no cells there." })], []);
  }

  forget() {
    this.chosen = null;
    this.select.value = "";
    this.told.replaceChildren();
  }

  async tellRegion({ region, place }) {
    const { text, attractors, x, y } = this.regions[region];
    const met = attractors.length ? "Attractors met in it, with fractions of its cells and 95 % intervals:" : "No attractor is met in it.";
    const parts = [el("p", { text }), el("p", { text: met }), el("ul", {}, ...attractors.map((line) => el("li", { text: line })))];
    const at = this.nearest(region, place ?? [x, y]), asked = (this.asked = {});
    if (!at) return this.tell([...parts, el("p", { text: "No parameter point of the run lies in it." })], []);
    try {
      const found = await this.plane.source.attractors({ at });
      if (asked !== this.asked) return;
      const there = found.attractors.filter(({ cell }) => cell !== null);
      const told = there.length ? "Orbits at" : "No orbit meets the section at";
      this.tell([...parts, el("p", { text: `${told} ${this.words(at)}, the nearest point with cells${there.length ? ":" : "."}` })], there.map(({ name, cell }) => [name, at, cell]));
    } catch (error) {
      if (asked === this.asked) this.tell([...parts, el("p", { text: error.message })], []);
    }
  }

  /** Tell, with a button for each orbit; the first orbit is shown. */
  tell(parts, orbits) {
    const buttons = orbits.map(([text, at, cell]) => el("button", { type: "button", text, on: { click: () => this.go(at, cell) } }));
    this.told.replaceChildren(...parts, el("div", { class: "buttons" }, ...buttons));
    if (orbits.length) this.go(orbits[0][1], orbits[0][2]);
  }

  /** Select a cell, as a click on one of its points does, in a diagram that has it. */
  go(at, cell) {
    const { state, diagram } = this.plane, own = state.get().at;
    const shown = Object.fromEntries(Object.entries(own).map(([name, index]) => [name, at[name] ?? index]));
    state.set({ curvePoint: null, eventPoint: null, at: shown, selected: { cell, point: diagram.skipped } });
  }

  /** Indices on the run's axes of the parameter point of a region that is nearest to a place, or null. */
  nearest(region, [x, y]) {
    const { axes, values: [xs, ys], indices, region: regions, at } = this.grid, { frame } = this.plane;
    let best = null, least = Infinity;
    regions.forEach((own, k) => {
      const [i, j] = [Math.floor(k / ys.length), k % ys.length];
      const away = Math.hypot(frame.x(xs[i]) - frame.x(x), frame.y(ys[j]) - frame.y(y));
      if (own === region && away < least) [best, least] = [{ ...at, [axes[0]]: indices[0][i], [axes[1]]: indices[1][j] }, away];
    });
    return best;
  }

  /** The values of a parameter point. */
  words(at) {
    const { axes, names, values, indices } = this.grid;
    return axes.map((name, k) => `${names[k]} = ${number(values[k][indices[k].indexOf(at[name])], 6)}`).join(", ");
  }

  // ---- painting ----------------------------------------------------------------------------

  paintRegions(ctx, frame) {
    for (const { rings, colour } of this.regions) {
      frame.trace(ctx, rings.map(({ x, y }) => x.flatMap((value, i) => [value, y[i]])));
      ctx.fillStyle = colour;
      ctx.fill("evenodd");
    }
  }

  paintLines(ctx, frame, colours) {
    frame.trace(ctx, this.lines.map(({ x, y }) => x.flatMap((value, i) => [value, y[i]])));
    for (const [width, colour, dashes] of [[3, colours.card, []], [1.2, colours.ink, [1.5, 3]]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.setLineDash(dashes);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    for (const [width, colour] of [[4, colours.card], [1.8, colours.ink]]) {
      ctx.beginPath();
      for (const { x, y } of this.marks) {
        const [px, py] = [frame.x(x), frame.y(y)];
        for (const side of [-1, 1]) {
          ctx.moveTo(px - CROSS, py - side * CROSS);
          ctx.lineTo(px + CROSS, py + side * CROSS);
        }
      }
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.stroke();
    }
  }

  paintChosen(ctx, frame, colours) {
    if (!this.chosen) return;
    const { mark, region } = this.chosen;
    if (mark === undefined) frame.trace(ctx, this.regions[region].rings.map(({ x, y }) => x.flatMap((value, i) => [value, y[i]])));
    else {
      ctx.beginPath();
      ctx.arc(frame.x(this.marks[mark].x), frame.y(this.marks[mark].y), 8, 0, 2 * Math.PI);
    }
    for (const [width, colour] of [[5, colours.card], [2.4, colours.accent]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.stroke();
    }
  }
}

/** Whether a closed ring holds a place. */
function holds({ x, y }, [px, py]) {
  let odd = false;
  for (let i = 1; i < x.length; i++) {
    if (y[i] > py !== y[i - 1] > py && px < x[i] + ((py - y[i]) / (y[i - 1] - y[i])) * (x[i - 1] - x[i])) odd = !odd;
  }
  return odd;
}
