// Tables of a view's data that the browser writes itself: CSV, in the columns of pipeline/explorer/data/tables.py.
// NetCDF needs magpend.

/** A field: what has commas, quotes or line ends is quoted; nothing stands for what has no value. */
function field(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "";
  let text = String(value);
  // a word that a spreadsheet would take for a formula stays a word
  if (typeof value === "string" && /^[=+\-@\t]/.test(text)) text = `'${text}`;
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** Lines of CSV as a Blob: what is told of all, names, rows; `rows` gives arrays of values. */
function csv(told, names, rows) {
  const heads = Object.entries(told).map(([name, value]) => `# ${name}: ${String(value).split(/\s+/).join(" ")}\n`);
  const parts = [...heads, `${names.map(field).join(",")}\n`];
  let lines = [];
  for (const row of rows) {
    lines.push(row.map(field).join(","));
    // one text of all lines of a large diagram would be held twice
    if (lines.length === 50_000) {
      parts.push(`${lines.join("\n")}\n`);
      lines = [];
    }
  }
  if (lines.length) parts.push(`${lines.join("\n")}\n`);
  return new Blob(parts, { type: "text/csv;charset=utf-8" });
}

/** A name with its unit, as the head of a column. */
function heading({ name, unit }) {
  return unit && unit !== "1" ? `${name} [${unit}]` : name;
}

/** Words of codes by number. */
function labelsOf(categories) {
  return new Map(categories.map(({ id, label }) => [id, label]));
}

/** Values of the axes that are not shown. */
function placeOf(view, x, at) {
  const others = view.axes.filter((axis) => axis.name !== x && axis.values.length > 1);
  return Object.fromEntries(others.map((axis) => [`at_${axis.name}`, axis.values[at?.[axis.name] ?? 0]]));
}

function* diagramRows({ arrays }, colours) {
  const { x, cell, at, first, y, status } = arrays;
  const words = colours.map((colour) => labelsOf(colour.categories));
  for (let i = 0; i < cell.length; i++) {
    const codes = colours.map((colour, k) => words[k].get(arrays[`colour_${colour.name}`][i]) ?? "");
    for (let k = first[i]; k < first[i + 1]; k++) yield [cell[i], x[at[i]], y[k], status[i], ...codes];
  }
}

function* curveRows({ curves }) {
  for (const { title, group, unit, x, y, low, high } of curves) {
    for (let i = 0; i < x.length; i++) yield [title, group, unit, x[i], y[i], (low ?? y)[i], (high ?? y)[i]];
  }
}

function* branchRows({ branches, points }) {
  for (const { id, period, segments } of branches) {
    for (const [k, { stable, x, y }] of segments.entries()) {
      for (let i = 0; i < x.length; i++) yield [id, period, stable ? "stable" : "unstable", k, x[i], y[i]];
    }
  }
  for (const { branch, period, kind, x, y } of points) for (const height of y) yield [branch, period, kind, -1, x, height];
}

function* orbitRows({ arrays }, nStates, nQuantities) {
  const row = (values, i, n) => Array.from(values?.subarray(i * n, (i + 1) * n) ?? []);
  for (let i = 0; i < arrays.time.length; i++) {
    yield [arrays.time[i], ...row(arrays.states, i, nStates), ...row(arrays.quantities, i, nQuantities)];
  }
}

function* planeRows({ attrs, arrays }) {
  const { u, v, label, starts, start_label: startLabel } = arrays, words = labelsOf(attrs.labels);
  if (attrs.source === null) {
    for (let i = 0; i < startLabel.length; i++) yield [starts[2 * i], starts[2 * i + 1], startLabel[i], words.get(startLabel[i]) ?? ""];
    return;
  }
  for (let j = 0; j < v.length; j++) {
    for (let i = 0; i < u.length; i++) {
      const code = label[j * u.length + i];
      yield [u[i], v[j], code, words.get(code) ?? ""];
    }
  }
}

const OF_SET = ["id", "name", "kind", "stability", "evidence", "period", "motion", "share", "low", "high"];

function* attractorRows({ attractors }) {
  for (const one of attractors) {
    const plain = OF_SET.map((name) => one[name]);
    for (const [k, point] of one.section.entries()) yield [...plain, k, ...point];
  }
}

/** Head and rows of each kind of table. */
const TABLES = {
  diagram: async (source, view, { x, y, at }) => {
    const colours = view.colours.filter(({ name }) => name !== "status" && name !== "seed");
    const axis = view.axes.find(({ name }) => name === x), vertical = view.verticals.find(({ name }) => name === y);
    const names = ["cell", heading(axis), heading(vertical), "status", ...colours.map(({ name }) => name)];
    return [placeOf(view, x, at), names, diagramRows(await source.diagram({ x, y, at }), colours)];
  },
  curves: async (source, view, { x, at }) =>
    [placeOf(view, x, at), ["curve", "group", "unit", x, "value", "low", "high"], curveRows(await source.curves({ x, at }))],
  branches: async (source, view, { x, y, at }) =>
    [placeOf(view, x, at), ["branch", "period", "what", "segment", x, y], branchRows(await source.branches({ x, y, at }))],
  orbit: async (source, view, { cell, point }) => {
    const { states, quantities } = view.model, answer = await source.orbit({ cell, point }), { attrs } = answer;
    const told = { cell, point, frequency: attrs.frequency, status: attrs.status, period: attrs.period, motion: attrs.motion, attractor: attrs.attractor, kind: attrs.kind, stability: attrs.stability, evidence: attrs.evidence, note: attrs.note };
    const known = Object.fromEntries(Object.entries(told).filter(([, value]) => value !== null && value !== undefined));
    return [known, ["time [s]", ...states.map(heading), ...quantities.map(heading)], orbitRows(answer, states.length, quantities.length)];
  },
  plane: async (source, view, { at }) => {
    const answer = await source.plane({ at });
    const units = answer.attrs.states.map((name) => heading(view.model.states.find((state) => state.name === name)));
    const fixed = Object.fromEntries(Object.entries(answer.attrs.fixed ?? {}).map(([name, value]) => [`fixed_${name}`, value]));
    return [{ ...placeOf(view, null, at), ...fixed }, [...units, "label", "name"], planeRows(answer)];
  },
  attractors: async (source, view, { at }) => {
    return [placeOf(view, null, at), [...OF_SET, "point", ...view.model.states.map(({ name }) => name)], attractorRows(await source.attractors({ at }))];
  },
};

/**
 * A view's data as CSV.
 * @param {Object} source
 * @param {string} kind "diagram", "curves", "branches", "orbit", "plane" or "attractors"
 * @param {Object} query as the source's own function takes it
 * @returns {Promise<Blob>}
 */
export async function tableOf(source, kind, query) {
  const [told, names, rows] = await TABLES[kind](source, await source.view(), query);
  return csv({ ...told, title: `${kind} of a run` }, names, rows);
}
