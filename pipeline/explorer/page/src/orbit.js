// An orbit as the source gives it: columns by name, the section points, and what is known of it.

import { visible } from "./palette.js";

/**
 * Columns of an orbit, a live path or a followed orbit.
 * @param {{attrs: Object, arrays: Object, shapes: Object}} packed
 * @param {Object} model `view.model`
 */
export class Orbit {
  constructor(packed, model) {
    this.attrs = packed.attrs;
    this.model = model;
    this.time = packed.arrays.time ?? new Float64Array(0);
    this.columns = new Map();
    split(packed, "states", model.states, this.columns);
    const kept = packed.attrs.quantities?.map((name) => ({ name })) ?? model.quantities ?? [];
    split(packed, "quantities", kept, this.columns);
    this.sections = new Map();
    split(packed, "section", model.states, this.sections);
    this.n = this.time.length;
    this.begin = this.n ? this.time[0] : 0;
    this.duration = this.n ? this.time[this.n - 1] - this.begin : 0;
    this.drawing = packed.arrays.drawing ?? null;
    this.nPoints = packed.shapes.drawing?.[1] ?? 0;
  }

  /** Whether it is known to attract (true), known not to (false), or not known (null). */
  get stable() {
    return this.attrs.stable ?? null;
  }

  column(name) {
    return this.columns.get(name) ?? new Float64Array(0);
  }

  section(name) {
    return this.sections.get(name) ?? new Float64Array(0);
  }
}

function split(packed, key, named, into) {
  const flat = packed.arrays[key];
  if (!flat) return;
  const [rows, width] = packed.shapes[key];
  named.slice(0, width).forEach(({ name }, k) => {
    const values = new Float64Array(rows);
    for (let i = 0; i < rows; i++) values[i] = flat[i * width + k];
    into.set(name, values);
  });
}

/** What a state or quantity is called on an axis: its letter and its unit. */
export function axisOf(model, name) {
  const found = [...model.states, ...(model.quantities ?? [])].find((entry) => entry.name === name);
  if (!found) return { label: name, angle: false };
  return { label: withUnit(found), angle: Boolean(found.angle) };
}

/** A label with its unit. */
export function withUnit({ label, name, unit }) {
  const text = label || name;
  return unit && unit !== "1" ? `${text} [${unit}]` : text;
}

const seen = new Map();

/** A colour as it is told from a card's; remembered, for drawings that move ask for it in every frame. */
function seenOn(colour, paper) {
  const key = `${colour} ${paper}`;
  if (!seen.has(key)) seen.set(key, visible(colour, paper));
  return seen.get(key);
}

/** Colour of an orbit: its attractor's where it attracts; where it does not, the ink's, which no attractor has. */
export function colourOf(orbit, view, colours) {
  const { stability } = orbit.attrs;
  if (orbit.stable === false || (stability && stability !== "attracts")) return colours.ink;
  const attractors = view.colours?.find((entry) => entry.name === "attractor");
  const category = attractors?.categories.find((entry) => entry.id === orbit.attrs.attractor);
  return category ? seenOn(category.colour, colours.card) : colours.accent;
}

/** Indices of all axes at the parameter values of an orbit. */
export function indicesOf(orbit, view) {
  if (orbit.attrs.at) return orbit.attrs.at;
  const at = {};
  for (const axis of view.axes) {
    const value = axis.name === "frequency" ? orbit.attrs.frequency : orbit.attrs.parameters?.[axis.parameter ?? axis.name];
    if (value === undefined || value === null) continue;
    at[axis.name] = axis.values.reduce((best, v, i) => (Math.abs(v - value) < Math.abs(axis.values[best] - value) ? i : best), 0);
  }
  return at;
}
