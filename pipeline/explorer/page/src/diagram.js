// The bifurcation diagram: bitmaps of the points by a worker, axes, branches and marks over them, and what
// wheel, fingers and keys do with it.

import { FONT, boxOf, paintAxes, paintFrame, placeX, placeY, told } from "./axes.js";
import { bifurcationAt, holding, paintBifurcations, paintBranches } from "./branches.js";
import { el, focusedIn } from "./dom.js";
import { Gestures, bounded } from "./gestures.js";
import { onKey } from "./keyboard.js";
import { bytesOf } from "./palette.js";
import { canvasOf } from "./picture.js";
import { Points } from "./points.js";
import { onTheme, theme } from "./theme.js";

/** Points drawn at most while the window moves; all are drawn when it rests. */
const MOVING = 1.2e6;
const REST = 160;
const VECTOR_POINTS = 20000;

export class Diagram {
  /**
   * @param {Object} state
   * @param {Object} source
   * @param {Object} view
   * @param {{say: function(string): void, problem: function(Error|null): void, told: function(Object): void}} reader
   * @param {boolean} wheelAlways whether the wheel zooms also while the diagram has no focus
   */
  constructor(state, source, view, reader, wheelAlways) {
    Object.assign(this, { state, source, view, reader, wheelAlways });
    this.points = new Points();
    this.lower = el("canvas", { "aria-hidden": "true" });
    this.upper = el("canvas", { "aria-hidden": "true" });
    this.tip = el("div", { class: "tip", role: "presentation", hidden: true });
    this.note = el("p", { class: "diagram-note", hidden: true });
    this.element = el("div", {
      class: "diagram", tabindex: "0", role: "application", "aria-roledescription": "diagram",
      "aria-label": "Bifurcation diagram: arrows move, + and - zoom, 0 shows all, Enter goes to a point, ? lists all keys",
    }, this.lower, this.upper, this.tip, this.note);
    this.full = this.ofPoints = [0, 1, 0, 1];
    [this.base, this.detail, this.data, this.branches, this.selection] = [null, null, null, null, null];
    [this.width, this.height, this.asked, this.version, this.skipped] = [0, 0, 0, 0, 0];
    this.listen();
  }

  listen() {
    const { state, element } = this;
    this.gestures = new Gestures(element, {
      takesWheel: () => this.takesWheel,
      box: () => this.box, window: () => this.window, set: (bounds) => this.moveTo(bounds), reset: () => this.reset(),
      tap: (x, y) => this.select(x, y), hover: (x, y) => this.hover(x, y), marked: (box) => this.setBox(box),
    });
    element.addEventListener("keydown", (event) => onKey(event, this));
    new ResizeObserver(() => this.measure()).observe(element);
    this.forget = onTheme(() => this.recolour());
    state.on(["x", "y", "at"], (_, changed) => this.load(changed));
    state.on(["colour", "hidden"], () => this.recolour());
    state.on(["window"], () => this.moved());
    state.on(["selected"], () => this.findSelection());
    state.on(["overlays"], () => this.loadBranches());
  }

  get takesWheel() {
    return this.wheelAlways || focusedIn(this.element.parentNode) !== null;
  }

  destroy() {
    this.forget();
    clearTimeout(this.resting);
    this.asked += 1; // what is still read is for nobody
    this.data = null;
    this.points.end();
  }

  /** What is shown of the plane. */
  get window() {
    return this.state.get().window ?? this.full;
  }

  get vertical() {
    return this.view.verticals.find(({ name }) => name === this.state.get().y);
  }

  get horizontal() {
    return this.view.axes.find(({ name }) => name === this.state.get().x);
  }

  get colouring() {
    return this.view.colours.find(({ name }) => name === this.state.get().colour) ?? null;
  }

  /** Ask for the points of the axes chosen; another vertical or horizontal axis begins with all of it. */
  async load(changed = []) {
    const { x, y, at, window } = this.state.get(), asked = ++this.asked;
    if (changed.includes("x") || changed.includes("y")) if (!changed.includes("window")) this.state.set({ window: null });
    this.element.setAttribute("aria-busy", "true");
    try {
      const packed = await this.source.diagram({ x, y, at, window });
      if (asked === this.asked) await this.take(packed, asked);
    } catch (error) {
      if (asked === this.asked) this.reader.problem(error);
    }
    if (asked === this.asked) this.element.removeAttribute("aria-busy");
  }

  async take({ arrays, attrs }, asked) {
    const { x, at, first, y, cell, status } = arrays, colours = {};
    for (const { name } of this.view.colours) colours[name] = arrays[`colour_${name}`]?.slice() ?? null;
    // the answer's buffer goes to the worker; what the page needs itself is small and kept
    this.data = { x: x.slice(), at: at.slice(), first: first.slice(), cell: cell.slice(), status: status.slice(), colours, attrs };
    const { extent, count } = await this.points.ask("load", { data: { x, at, first, y } }, this.points.worker ? [y.buffer] : []);
    if (asked !== this.asked) return;
    this.ofPoints = fullOf(this.data.x, attrs.extent ?? extent, this.horizontal);
    this.full = holding(this.ofPoints, this.branches);
    // a diagram of very many points has the last sections of each cell only
    this.skipped = (attrs.n_keep ?? 0) - (attrs.kept ?? attrs.n_keep ?? 0);
    this.count = count;
    this.reader.problem(null);
    this.reader.told({ count, data: this.data, attrs });
    this.note.hidden = extent !== null;
    this.note.textContent = extent === null ? this.emptiness() : "";
    [this.base, this.detail] = [null, null];
    this.recolour();
    this.findSelection();
    this.loadBranches();
  }

  emptiness() {
    const { total, pending } = this.view.cells;
    if (pending === total) return "No cell of this run is computed yet. magpend run goes on with it.";
    return pending
      ? "No finished cell has points here. Some cells are still pending."
      : "No cell here has points: they diverged, failed, or rest. The report and magpend status say which.";
  }

  async loadBranches() {
    const { x, y, at, overlays } = this.state.get();
    const wanted = overlays.branches && this.view.has.branches ? JSON.stringify([x, y, at]) : null;
    if (wanted === this.branchesOf) return;
    this.branchesOf = wanted;
    this.setBranches(null);
    if (!wanted) return;
    try {
      const found = await this.source.branches({ x, y, at });
      if (wanted === this.branchesOf) this.setBranches(found);
    } catch (error) {
      this.reader.say(error.message);
    }
  }

  /** Take other branches; the whole of the diagram holds them. */
  setBranches(found) {
    this.branches = found;
    const full = holding(this.ofPoints, found), isSame = String(full) === String(this.full);
    if (this.data && !isSame) {
      this.full = full;
      this.version += 1;
      [this.base, this.detail] = [null, null];
      this.draw(true);
    }
    this.repaint();
  }

  /** Send the cells' colours to the worker and draw again. */
  async recolour() {
    if (!this.data) return this.repaint();
    const { colour, hidden } = this.state.get(), { colours, at } = this.data;
    const bytes = bytesOf(colours[colour], at.length, this.colouring, hidden[colour] ?? [], theme().card);
    this.version += 1;
    await this.points.ask("colours", { bytes });
    this.draw(true);
  }

  measure() {
    const width = Math.floor(this.element.clientWidth), height = Math.floor(this.element.clientHeight);
    const pixels = window.devicePixelRatio || 1;
    if (!width || !height || (width === this.width && height === this.height && pixels === this.pixels)) return;
    Object.assign(this, { width, height, pixels, box: boxOf(width, height) });
    for (const canvas of [this.lower, this.upper]) {
      [canvas.width, canvas.height] = [Math.round(width * pixels), Math.round(height * pixels)];
    }
    this.repaint();
    this.draw(true);
  }

  /** Go to a window: at once with the bitmap that is there, then drawn anew. */
  moveTo(bounds) {
    if (this.data) this.state.set({ window: bounded(bounds, this.full) });
  }

  reset() {
    this.state.set({ window: null });
  }

  moved() {
    this.tip.hidden = true;
    this.hovered = null;
    this.repaint();
    this.draw(false);
    const covers = this.data?.attrs.covers;
    if (covers && !this.within(covers)) this.load();
  }

  within([low, high]) {
    const [x0, x1] = this.window;
    return Math.max(x0, this.ofPoints[0]) >= low && Math.min(x1, this.ofPoints[1]) <= high;
  }

  /** Draw the window: quickly while it moves, wholly when it rests. */
  draw(wholly) {
    if (!this.data || !this.width) return;
    clearTimeout(this.resting);
    this.render(wholly ? Infinity : MOVING);
    if (!wholly) this.resting = setTimeout(() => this.detail?.part !== 1 && this.render(Infinity), REST);
  }

  async render(most) {
    const { version, window: bounds, pixels } = this, asked = this.asked;
    const width = Math.round(this.box.width * pixels), height = Math.round(this.box.height * pixels);
    const made = await this.points.ask("render", { bounds, width, height, scale: pixels, most });
    if (!made || version !== this.version || asked !== this.asked) return made?.bitmap.close();
    const whole = bounds === this.full || !this.base;
    if (this.detail && this.detail !== this.base) this.detail.bitmap.close();
    this.detail = made;
    if (whole && bounds === this.full) {
      this.base?.bitmap.close();
      this.base = made;
    }
    this.repaint();
    this.element.dataset.drawn = String(Number(this.element.dataset.drawn ?? 0) + 1);
    if (!this.base && bounds !== this.full && most === Infinity) this.renderBase();
  }

  // what lies beyond the last bitmap while one pans: all of the diagram, as coarse as it comes
  async renderBase() {
    const { version, full, pixels } = this;
    const width = Math.round(this.box.width * pixels), height = Math.round(this.box.height * pixels);
    const made = await this.points.ask("render", { bounds: full, width, height, scale: pixels, most: 2 * MOVING, keep: true });
    if (version !== this.version || this.base || full !== this.full) return made.bitmap.close();
    this.base = made;
  }

  repaint() {
    if (this.frame || !this.width) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      const ctx = this.begin(this.lower);
      this.paint(ctx, this.box, theme(), () => this.paintBitmaps(ctx));
      this.paintUpper();
    });
  }

  begin(canvas) {
    const ctx = canvas.getContext("2d");
    ctx.setTransform(this.pixels, 0, 0, this.pixels, 0, 0);
    ctx.clearRect(0, 0, this.width, this.height);
    ctx.font = FONT;
    return ctx;
  }

  /** Paint the diagram into any context; `points` paints the points. */
  paint(ctx, box, colours, points) {
    paintAxes(ctx, box, this.window, this.axes(), colours);
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.width, box.height);
    ctx.clip();
    if (this.branches) paintBranches(ctx, box, this.window, this.branches, colours, true);
    points();
    if (this.branches) {
      paintBranches(ctx, box, this.window, this.branches, colours, false);
      paintBifurcations(ctx, box, this.window, this.branches, colours);
    }
    ctx.restore();
    paintFrame(ctx, box, colours);
    this.events?.paint(ctx, box, this.window, colours);
  }

  axes() {
    const { label, unit, factor } = this.horizontal ?? { label: "", unit: "" };
    return { x: { label, unit, factor }, y: this.vertical };
  }

  paintBitmaps(ctx) {
    const { detail, base, window: shown, box } = this;
    if (!detail) return;
    if (detail.bounds === shown || String(detail.bounds) === String(shown)) {
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(detail.bitmap, box.left, box.top, box.width, box.height);
      return;
    }
    ctx.imageSmoothingEnabled = true;
    if (base && base !== detail) {
      const [left, top, width, height] = placed(box, shown, detail.bounds);
      ctx.save();
      ctx.beginPath();
      ctx.rect(box.left, box.top, box.width, box.height);
      ctx.rect(left, top, width, height);
      ctx.clip("evenodd");
      ctx.drawImage(base.bitmap, ...placed(box, shown, base.bounds));
      ctx.restore();
    }
    ctx.drawImage(detail.bitmap, ...placed(box, shown, detail.bounds));
  }

  paintUpper() {
    const ctx = this.begin(this.upper), colours = theme(), { box, window: bounds } = this;
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.width, box.height);
    ctx.clip();
    if (this.selection) this.ring(ctx, this.selection, 7, colours.ink, colours.card, true);
    if (this.hovered) this.ring(ctx, this.hovered, 5, colours.accent, colours.card, false);
    ctx.restore();
    if (this.marked) {
      const [xa, ya, xb, yb] = this.marked;
      ctx.strokeStyle = colours.accent;
      ctx.setLineDash([4, 3]);
      ctx.strokeRect(Math.min(xa, xb) + 0.5, Math.min(ya, yb) + 0.5, Math.abs(xb - xa), Math.abs(yb - ya));
      ctx.setLineDash([]);
    }
    this.onPainted?.(bounds, box);
  }

  ring(ctx, { x, y }, radius, colour, ground, cross) {
    const px = placeX(this.box, this.window, x), py = placeY(this.box, this.window, y);
    if (cross) {
      ctx.globalAlpha = 0.45;
      ctx.fillStyle = colour;
      ctx.fillRect(Math.round(px), this.box.top, 1, this.box.height);
      ctx.globalAlpha = 1;
    }
    for (const [stroke, width] of [[ground, 5], [colour, 2]]) {
      ctx.beginPath();
      ctx.arc(px, py, radius, 0, 2 * Math.PI);
      ctx.strokeStyle = stroke;
      ctx.lineWidth = width;
      ctx.stroke();
    }
  }

  setBox(box) {
    this.marked = box;
    this.tip.hidden = true;
    this.repaint();
  }

  nearestTo(px, py, reach) {
    const { box, window: bounds } = this;
    const [x0, x1, y0, y1] = bounds;
    return this.points.ask("nearest", {
      bounds, width: box.width, height: box.height, reach,
      x: x0 + ((px - box.left) / box.width) * (x1 - x0), y: y1 - ((py - box.top) / box.height) * (y1 - y0),
    });
  }

  // one question at a time; the last place asked for is the one that counts
  async hover(px, py) {
    this.pointer = px === null ? null : [px, py];
    if (this.looking || !this.data) return;
    this.looking = true;
    while (this.pointer !== undefined) {
      const place = this.pointer;
      this.pointer = undefined;
      const found = place ? await this.nearestTo(...place, 16) : null;
      if (this.pointer === undefined) this.showTip(found, place);
    }
    this.looking = false;
  }

  showTip(found, place) {
    if (!found && !this.hovered && this.tip.hidden) return;
    this.hovered = found;
    this.repaintUpper();
    const special = place && this.branches ? bifurcationAt(this.box, this.window, this.branches.points, ...place) : null;
    const event = place ? this.events?.at(this.box, this.window, ...place) : null;
    this.tip.hidden = !found && !special && !event;
    if (this.tip.hidden) return;
    const lines = event ? [event.sentence] : special ? [`${special.kind}: ${this.horizontal.label} = ${told(special.x * this.horizontal.factor, 0)} ${unitOf(this.horizontal)}`] : [];
    if (found && !event) lines.push(...this.described(found));
    this.tip.replaceChildren(...lines.map((text) => el("div", { text })));
    const right = place[0] > this.width / 2;
    this.tip.style.left = right ? "auto" : `${place[0] + 16}px`;
    this.tip.style.right = right ? `${this.width - place[0] + 16}px` : "auto";
    this.tip.style.top = `${Math.max(4, Math.min(place[1] + 12, this.height - 96))}px`;
  }

  repaintUpper() {
    if (!this.frame) requestAnimationFrame(() => this.width && this.paintUpper());
  }

  /** A point as lines of text: its place, what its cell is called, its cell. */
  described({ index, point, x, y }) {
    const [x0, x1, y0, y1] = this.window, { horizontal, vertical, data, colouring } = this;
    const lines = [`${horizontal.label} = ${told(x * horizontal.factor, (x1 - x0) * horizontal.factor)} ${unitOf(horizontal)}`.trim(), `${vertical.label} = ${told(y, y1 - y0)} ${unitOf(vertical)}`.trim()];
    const code = data.colours[colouring?.name]?.[index];
    const category = colouring?.categories.find(({ id }) => id === code);
    if (category) lines.push(category.label);
    lines.push(`cell ${data.cell[index]}, section ${point + this.skipped + 1}`);
    return lines;
  }

  async select(px, py) {
    if (!this.data) return;
    const event = this.events?.at(this.box, this.window, px, py);
    if (event) return this.events.choose(event);
    const found = await this.nearestTo(px, py, 24);
    if (found) this.choose(found);
  }

  /** Select a point; a selection outside of the window brings it there. */
  choose(found) {
    this.selection = found;
    this.state.set({ selected: { cell: this.data.cell[found.index], point: found.point + this.skipped } });
    this.reader.say(this.described(found).join(", "));
    this.bringIn(found);
    this.repaint();
  }

  bringIn({ x, y }) {
    const [x0, x1, y0, y1] = this.window;
    const dx = x < x0 || x > x1 ? x - (x0 + x1) / 2 : 0, dy = y < y0 || y > y1 ? y - (y0 + y1) / 2 : 0;
    if (dx || dy) this.moveTo([x0 + dx, x1 + dx, y0 + dy, y1 + dy]);
  }

  /** Go from the selected point to a next one; from none to that in the middle. */
  async walk(direction) {
    if (!this.data) return;
    if (!this.selection) {
      const { left, top, width, height } = this.box;
      const found = await this.nearestTo(left + width / 2, top + height / 2, Math.max(width, height));
      return found && this.choose(found);
    }
    const [, , y0, y1] = this.window;
    const found = await this.points.ask("step", { from: this.selection, direction, resolution: (y1 - y0) / this.box.height });
    if (found) this.choose(found);
    else this.reader.say("No further point that way.");
  }

  async findSelection() {
    const { selected } = this.state.get();
    const index = selected && this.data ? this.data.cell.indexOf(selected.cell) : -1;
    this.selection = index < 0 ? null : await this.points.ask("locate", { index, point: selected.point - this.skipped });
    this.repaint();
  }

  /** Paint all of it for a file: points as circles if they are few, else as a bitmap of twice the pixels. */
  async paintPicture(ctx, colours, isVector) {
    const { box, window: bounds } = this;
    const few = isVector ? await this.points.ask("points", { bounds, most: VECTOR_POINTS }) : null;
    const made = few ? null : await this.points.ask("render", {
      bounds, width: 2 * Math.round(box.width), height: 2 * Math.round(box.height), scale: 2, keep: true,
    });
    const image = made && canvasOf(made.bitmap);
    this.paint(ctx, box, colours, () => {
      if (few) paintFew(ctx, box, bounds, few);
      else ctx.drawImage(image, box.left, box.top, box.width, box.height);
    });
  }
}

function unitOf({ unit }) {
  return !unit || unit === "1" ? "" : unit;
}

function placed(box, shown, [x0, x1, y0, y1]) {
  const left = placeX(box, shown, x0), top = placeY(box, shown, y1);
  return [left, top, placeX(box, shown, x1) - left, placeY(box, shown, y0) - top];
}

/** All there is, with some room about it. */
function fullOf(x, extent, axis) {
  const values = axis?.values.length ? axis.values : x;
  let [x0, x1] = [Math.min(values[0], values.at(-1)), Math.max(values[0], values.at(-1))];
  let [y0, y1] = extent ?? [0, 1];
  const room = 0.015 * (x1 - x0) || 0.05 * Math.abs(x0) || 0.5;
  const above = 0.04 * (y1 - y0) || 0.05 * Math.abs(y0) || 0.5;
  return [x0 - room, x1 + room, y0 - above, y1 + above];
}

function paintFew(ctx, box, bounds, few) {
  for (let k = 0; k < few.length; k += 3) {
    const word = few[k + 2];
    ctx.fillStyle = `#${[word & 255, (word >> 8) & 255, (word >> 16) & 255].map((part) => part.toString(16).padStart(2, "0")).join("")}`;
    ctx.beginPath();
    ctx.arc(placeX(box, bounds, few[k]), placeY(box, bounds, few[k + 1]), 1, 0, 2 * Math.PI);
    ctx.fill();
  }
}
