// Where a copy's page has its numbers from: objects of data that were written once; nothing computes here.

import { Cells } from "./cells.js";
import { parseData, placeKey, unpackData } from "./export-data.js";
import { tableOf } from "./formats.js";
import { SourceError } from "./source-error.js";

const NONE = 0xffffffff;
/** What an orbit is to a cell, as pipeline/explorer/copies/orbits.py says it. */
const SAME_ATTRACTOR = 1, ALIKE = 2;

/** A source over objects by name; the kinds of copies say where these are, and where the columns. */
export class ExportSource {
  constructor() {
    this.live = null;
    this.formats = ["csv"];
    this.notice = null;
    this.kept = new Map();
    this.begun = null;
  }

  /** Content of an object of data, decompressed: an ArrayBuffer. */
  async object(name) {
    throw new Error(`${name}: a source must say where its objects are`);
  }

  /**
   * Points of the selected cells: of cell i those are y[first[i]] to y[first[i + 1]].
   * @returns {Promise<{first: Uint32Array, y: Float64Array}>}
   */
  async column(y) {
    throw new Error(`${y}: a source must say where its columns are`);
  }

  /** Status and codes of the selected cells by name. */
  async layers() {
    throw new Error("a source must say where its layers are");
  }

  /** An object that is read and kept, by name; one that failed may be asked for again. */
  once(name, read) {
    if (!this.kept.has(name)) {
      this.kept.set(name, this.object(name).then(read).catch((error) => {
        this.kept.delete(name);
        throw error;
      }));
    }
    return this.kept.get(name);
  }

  json(name) {
    return this.once(name, parseData);
  }

  packed(name) {
    return this.once(name, unpackData);
  }

  /** What the run is; with the first question the copy says what it is itself. */
  view() {
    this.begun ??= this.begin().catch((error) => {
      this.begun = null;
      throw error;
    });
    return this.begun;
  }

  async begin() {
    const { view, about } = await this.json("view");
    this.described = view;
    this.about = about;
    this.cells = new Cells(about.dims, view.axes);
    this.notice = about.notice;
    return view;
  }

  async diagram({ x, y, at, window = null }) {
    const vertical = this.described.verticals.find((one) => one.name === y);
    const selection = this.cells.select(x, at, this.needsWindow() ? window?.slice(0, 2) ?? null : null);
    const [column, layers] = await Promise.all([this.column(y, selection), this.layers(selection)]);
    const { status, ...codes } = layers;
    const arrays = { x: selection.x, cell: selection.cell, at: selection.at, ...column, status };
    for (const [name, values] of Object.entries(codes)) arrays[name] = values;
    const place = Object.fromEntries(this.described.axes.filter((axis) => axis.name !== x && this.isDim(axis.name))
      .map((axis) => [axis.name, at?.[axis.name] ?? 0]));
    const attrs = { x, y, unit: vertical.unit, at: place, kept: this.described.n_keep, n_keep: this.described.n_keep };
    if (selection.covers) attrs.covers = selection.covers;
    return { attrs, arrays, shapes: Object.fromEntries(Object.entries(arrays).map(([k, v]) => [k, [v.length]])) };
  }

  isDim(name) {
    return this.cells.dims.some((dim) => dim.name === name);
  }

  /** Whether a diagram is too large to be read at once. */
  needsWindow() {
    return false;
  }

  /** An answer that was written for one place of the axes. */
  async answer(kind, key) {
    const { blocks, missing, alike } = this.about.answers[kind];
    if (alike) return alike;
    if (blocks[key] === undefined) throw new SourceError(missing || `This copy has no ${kind} here.`);
    return (await this.json(`${kind}-${blocks[key]}`))[key];
  }

  curves({ x, at }) {
    return this.answer("curves", placeKey(this.described.axes, at, x));
  }

  branches({ x, y, at }) {
    return this.answer("branches", `y=${y}&${placeKey(this.described.axes, at, x)}`);
  }

  events({ x, at }) {
    return this.answer("events", placeKey(this.described.axes, at, x));
  }

  attractors({ at }) {
    return this.answer("attractors", placeKey(this.described.axes, at));
  }

  disturbances({ at }) {
    return this.answer("disturbances", placeKey(this.described.axes, at));
  }

  async plane({ at }) {
    const { objects, missing, none } = this.about.planes;
    const name = objects[placeKey(this.described.axes, at)];
    if (name !== undefined) return this.packed(name);
    if (missing) throw new SourceError(missing);
    return { attrs: none, arrays: {}, shapes: {} };
  }

  /** The stored orbit for a cell, with the cell's own sections where it lies at the same parameters. */
  async orbit({ cell, point }) {
    const { missing, blocks } = this.about.orbits;
    if (missing) throw new SourceError(missing);
    const index = await this.packed("orbit-index");
    const k = index.arrays.orbit[cell];
    if (k === undefined || k === NONE) throw new SourceError("This cell has no points, so it has no orbit.");
    const stored = await this.packed(`orbits-${blocks.findLastIndex((first) => first <= k)}`);
    const { arrays, shapes } = partOf(stored, `${k}.`), attrs = { ...stored.attrs[k] };
    if (attrs.failed) throw new SourceError(`The orbit of cell ${attrs.cell} could not be integrated: ${attrs.failed}`);
    const how = index.arrays.how[cell], same = how === SAME_ATTRACTOR || how === ALIKE;
    attrs.note = this.noteOf(attrs, cell, how);
    const sections = await this.sections(same ? cell : attrs.cell);
    arrays.section = sections.values;
    shapes.section = sections.shape;
    if (same && attrs.cell !== cell) {
      const { status } = await this.layers(this.single(cell));
      Object.assign(attrs, { status: this.about.status[status[0]] ?? attrs.status, start: null });
      // of a cell that is alike its own start alone is known, which is not this cell's
      if (how === ALIKE) attrs.seeds = [];
    }
    Object.assign(attrs, { stored: attrs.cell, cell, point });
    return { attrs, arrays, shapes };
  }

  /** What the shown orbit is to the cell that was asked for. */
  noteOf(attrs, cell, how) {
    if (attrs.cell === cell) return "This orbit of the very cell was integrated when the copy was made.";
    const of = { [SAME_ATTRACTOR]: "of the attractor that this cell settled on", [ALIKE]: "of a cell with the same period and motion" }[how];
    if (of) return `Shown is the orbit ${of}, integrated from cell ${attrs.cell} when the copy was made; the section points are cell ${cell}'s own.`;
    const place = this.cells.at(attrs.cell);
    const where = this.described.axes.map((axis) => `${axis.label} ${axis.values[place[axis.name]]} ${axis.unit}`.trim());
    return `This copy has no orbit at these parameters. Shown is the nearest that it has, of cell ${attrs.cell}, at ${where.join(", ")}.`;
  }

  /** A selection of one cell. */
  single(cell) {
    const place = this.cells.place(cell);
    return { cell: Uint32Array.of(cell), ranges: this.cells.dims.map((dim) => [place[dim.name], place[dim.name] + 1]) };
  }

  /** The states at the sections of a cell that the copy has, as `section` of an orbit. */
  async sections(cell) {
    const names = this.described.model.states.map((state) => state.name);
    const columns = await Promise.all(names.map((name) => this.column(name, this.single(cell))));
    const n = columns[0].y.length, values = new Float64Array(n * names.length);
    columns.forEach(({ y }, i) => y.forEach((value, k) => { values[k * names.length + i] = value; }));
    return { values, shape: [n, names.length] };
  }

  async table(kind, query, format) {
    if (format !== "csv") throw new SourceError("A copy gives CSV alone; magpend explore gives NetCDF, too.");
    return tableOf(this, kind, query);
  }

  /** A copy writes no specification; it says what does. */
  async zoom({ x, axes, at = {} }) {
    const name = axes?.[0] ?? this.described.axes[0].name, digits = (value) => String(Number(value.toPrecision(7)));
    const pins = this.described.axes.filter((axis) => axis.name !== name && axis.values.length > 1)
      .map((axis) => ` --at ${axis.name}=${axis.values[at[axis.name] ?? 0]}`);
    const command = `magpend zoom ${this.described.name} --axis ${name}=${digits(x[0])}:${digits(x[1])}${pins.join("")} --out closer.toml`;
    throw new SourceError(`A copy computes nothing. Where the run is, this command writes the specification: ${command}`);
  }
}

/** Arrays of one of several things that lie in an object, by a prefix of their names. */
function partOf({ arrays, shapes }, prefix) {
  const part = { arrays: {}, shapes: {} };
  for (const name of Object.keys(arrays).filter((one) => one.startsWith(prefix))) {
    part.arrays[name.slice(prefix.length)] = arrays[name];
    part.shapes[name.slice(prefix.length)] = shapes[name];
  }
  return part;
}
