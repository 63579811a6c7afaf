// Tables of a view's data that the browser writes itself: CSV. NetCDF needs magpend.

/** A field: what has commas, quotes or line ends is quoted; nothing stands for what has no value. */
function field(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "";
  const text = String(value);
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** Lines of CSV as a Blob; `rows` gives arrays of values. */
function csv(names, rows) {
  const parts = [`${names.map(field).join(",")}\n`];
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

/** Words of codes by number. */
function labelsOf(categories) {
  return new Map(categories.map(({ id, label }) => [id, label]));
}

function* diagramRows({ arrays }, colours) {
  const { x, cell, at, first, y } = arrays;
  const words = colours.map((colour) => labelsOf(colour.categories));
  for (let i = 0; i < cell.length; i++) {
    const codes = colours.map((colour, k) => words[k].get(arrays[`colour_${colour.name}`][i]) ?? null);
    for (let k = first[i]; k < first[i + 1]; k++) yield [x[at[i]], cell[i], y[k], ...codes];
  }
}

function* curveRows({ curves }) {
  for (const curve of curves) {
    for (let i = 0; i < curve.x.length; i++) yield [curve.name, curve.x[i], curve.y[i], curve.low?.[i], curve.high?.[i], curve.unit];
  }
}

function* branchRows({ branches, points }) {
  for (const branch of branches) {
    for (const { stable, x, y } of branch.segments) {
      for (let i = 0; i < x.length; i++) yield [branch.id, branch.period, stable ? "stable" : "unstable", x[i], y[i], null];
    }
  }
  for (const point of points) {
    for (const y of [point.y].flat()) yield [point.branch, null, null, point.x, y, point.kind];
  }
}

function* orbitRows({ arrays }, names) {
  const tables = [["states", names.states], ["quantities", names.quantities]];
  for (let i = 0; i < arrays.time.length; i++) {
    const row = [arrays.time[i]];
    for (const [name, columns] of tables) {
      for (let k = 0; k < columns.length; k++) row.push(arrays[name]?.[i * columns.length + k]);
    }
    yield row;
  }
}

function* planeRows({ attrs, arrays }) {
  const { u, v, label } = arrays, words = labelsOf(attrs.labels);
  for (let j = 0; j < v.length; j++) {
    for (let i = 0; i < u.length; i++) yield [u[i], v[j], words.get(label[j * u.length + i]) ?? null];
  }
}

function* attractorRows({ attractors }, states) {
  for (const one of attractors) {
    for (const point of one.section) {
      yield [one.id, one.kind, one.period, one.motion, one.share, one.low, one.high, ...states.map((_, k) => point[k])];
    }
  }
}

/**
 * A view's data as CSV.
 * @param {Object} source
 * @param {string} kind "diagram", "curves", "branches", "orbit", "plane" or "attractors"
 * @param {Object} query as the source's own function takes it
 * @returns {Promise<Blob>}
 */
export async function tableOf(source, kind, query) {
  const view = await source.view();
  const states = view.model.states.map((state) => state.name);
  switch (kind) {
    case "diagram": return csv([query.x, "cell", query.y, ...view.colours.map((one) => one.name)], diagramRows(await source.diagram(query), view.colours));
    case "curves": return csv(["name", query.x, "value", "low", "high", "unit"], curveRows(await source.curves(query)));
    case "branches": return csv(["branch", "period", "stability", query.x, query.y, "bifurcation"], branchRows(await source.branches(query)));
    case "orbit": {
      const quantities = view.model.quantities.map((one) => one.name);
      return csv(["time", ...states, ...quantities], orbitRows(await source.orbit(query), { states, quantities }));
    }
    case "plane": {
      const answer = await source.plane(query);
      if (!answer.attrs.source) throw new Error("There is nothing of this plane to write.");
      return csv([...answer.attrs.states, "label"], planeRows(answer));
    }
    case "attractors": return csv(["attractor", "kind", "period", "motion", "share", "low", "high", ...states], attractorRows(await source.attractors(query), states));
    default: throw new Error(`${kind}: no such table`);
  }
}
