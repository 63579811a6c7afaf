// The view in the address: what stands behind # says what is shown, so that a link shows it again.

/** What is kept in the address. */
export const KEPT = ["x", "y", "at", "colour", "window", "selected", "plane", "panel", "overlays", "hidden"];

const OVERLAYS = ["branches", "events", "exponents", "fractions"];

/** Name of the colouring in which all points are alike. */
export const ONE = "one";

// many starts in as many colours are a speckle: they begin in one
function firstColour(view) {
  const [first] = view.colours;
  return first && !(first.name === "seed" && first.categories.length > 6) ? first.name : ONE;
}

/** What a view begins with. */
export function defaults(view) {
  const path = view.axes.find((axis) => axis.path) ?? view.axes[0];
  return {
    x: path?.name ?? null, y: view.verticals[0].name, at: atFor(view, path?.name, {}), colour: firstColour(view),
    window: null, selected: null, curvePoint: null, eventPoint: null, plane: null, panel: null, hidden: {},
    overlays: { branches: view.has.branches, events: Boolean(view.has.events), exponents: view.has.lyapunov, fractions: view.has.attractors },
  };
}

/** Indices on all axes but the horizontal one: those given where they exist, else the first. */
export function atFor(view, x, given) {
  const at = {};
  for (const axis of view.axes) {
    if (axis.name === x) continue;
    const index = given[axis.name];
    at[axis.name] = Number.isInteger(index) && index >= 0 && index < axis.values.length ? index : 0;
  }
  return at;
}

/**
 * Write a state as what stands behind #.
 * @param {Object} state
 * @param {Object} view as the source describes the run; what is as it begins is left out
 */
export function toAddress(state, view) {
  const begin = defaults(view), parts = [];
  const put = (key, value) => parts.push(`${key}=${encodeURIComponent(value).replaceAll("%2C", ",")}`);
  for (const key of ["x", "y", "colour", "panel"]) if (state[key] && state[key] !== begin[key]) put(key, state[key]);
  for (const [axis, index] of Object.entries(state.at)) if (index) put(`at.${axis}`, index);
  if (state.window) put("window", state.window.join(","));
  if (state.selected) put("point", `${state.selected.cell},${state.selected.point}`);
  if (state.plane) put("plane", state.plane.states.join(","));
  const shown = OVERLAYS.filter((name) => state.overlays[name]);
  if (shown.join() !== OVERLAYS.filter((name) => begin.overlays[name]).join()) put("show", shown.join(",") || "none");
  for (const [colour, ids] of Object.entries(state.hidden)) if (ids.length) put(`hide.${colour}`, ids.join(","));
  return parts.join("&");
}

/**
 * Read what stands behind #; what the run does not have is left as it begins.
 * @param {string} text without #
 * @param {Object} view
 * @returns {Object} a whole state
 */
export function fromAddress(text, view) {
  const query = new URLSearchParams(text.replaceAll("+", "%2B"));
  const state = defaults(view);
  const among = (key, names) => (names.includes(query.get(key)) ? query.get(key) : state[key]);
  state.x = among("x", view.axes.map((axis) => axis.name));
  state.y = among("y", view.verticals.map((vertical) => vertical.name));
  state.colour = among("colour", [...view.colours.map((colour) => colour.name), ONE]);
  state.panel = query.get("panel") ?? state.panel;
  const given = {};
  for (const axis of view.axes) if (query.has(`at.${axis.name}`)) given[axis.name] = Number(query.get(`at.${axis.name}`));
  state.at = atFor(view, state.x, given);
  state.window = readWindow(query.get("window"));
  const point = (query.get("point") ?? "").split(",").map(Number);
  if (point.length === 2 && point.every((k) => Number.isInteger(k) && k >= 0)) state.selected = { cell: point[0], point: point[1] };
  const plane = (query.get("plane") ?? "").split(",");
  if (plane.length === 2 && plane.every((name) => view.model.states.some((s) => s.name === name))) state.plane = { states: plane };
  if (query.has("show")) {
    const shown = query.get("show").split(",");
    state.overlays = Object.fromEntries(OVERLAYS.map((name) => [name, shown.includes(name)]));
  }
  for (const { name } of view.colours) {
    const ids = (query.get(`hide.${name}`) ?? "").split(",").filter(Boolean).map(Number).filter(Number.isInteger);
    if (ids.length) state.hidden[name] = ids;
  }
  return state;
}

function readWindow(text) {
  const bounds = (text ?? "").split(",").map(Number);
  const isOne = text && bounds.length === 4 && bounds.every(Number.isFinite) && bounds[1] > bounds[0] && bounds[3] > bounds[2];
  return isOne ? bounds : null;
}

/**
 * Keep an address and a state alike, both ways: every change that settles is written, so that where the place
 * has a history the back button undoes it.
 * @param {Object} state from `createState`
 * @param {Object} view
 * @param {{read: function(): string, write: function(string, boolean): void, on: function(function): function}} place
 *   of the address; `write` is told whether it is a new entry
 * @param {number} [settle] ms without a change of the window after which it counts
 * @returns {function(): void} ends it
 */
export function keepAddress(state, view, place, settle = 500) {
  let timer = null, reading = false;
  const write = () => {
    const wanted = toAddress(state.get(), view);
    if (wanted !== place.read()) place.write(wanted, !reading);
  };
  const ends = [state.on(KEPT, (_, changed) => {
    clearTimeout(timer);
    if (!reading && changed.every((key) => key === "window")) timer = setTimeout(write, settle);
    else write();
  })];
  ends.push(place.on(() => {
    clearTimeout(timer);
    reading = true;
    state.set(fromAddress(place.read(), view));
    reading = false;
  }));
  return () => {
    clearTimeout(timer);
    for (const end of ends) end();
  };
}
