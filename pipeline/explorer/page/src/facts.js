// What is known of an orbit, in words and numbers.

import { el } from "./dom.js";
import { withUnit } from "./orbit.js";

/** A number as people read it: four significant digits, or what `digits` says. */
export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "not known";
  const text = Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3) ? value.toExponential(digits - 1) : String(Number(value.toPrecision(digits)));
  return text.replace("-", "−");
}

/** A share in percent, with its interval where one is known. */
export function share(attrs) {
  if (attrs.share === null || attrs.share === undefined) return null;
  const percent = (value) => `${(100 * value).toFixed(1)} %`;
  const known = Number.isFinite(attrs.low) && Number.isFinite(attrs.high) && attrs.low !== null;
  return known ? `${percent(attrs.share)} (95 %: ${percent(attrs.low)} to ${percent(attrs.high)})` : percent(attrs.share);
}

/** What the stability of a set rests on. */
const EVIDENCE = {
  eigenvalues: "shown by its eigenvalues", multipliers: "shown by its multipliers",
  approach: "trajectories on both sides come nearer", stayed: "all extended cells stayed",
  left: "extended cells left it", volume: "the flow preserves volume",
  one_side: "trajectories of one side come nearer, those of the other leave",
  step_limit: "no orbit found: Newton's method met the step limit",
  no_return: "no orbit found: a trajectory of Newton's method did not come back to the section",
  no_convergence: "no orbit found: Newton's method did not converge",
};

/** Whether a set attracts and what shows it; of an orbit that the analysis does not know what its multipliers say. */
export function stabilityOf({ attrs, stable }) {
  if (attrs.stability) return [attrs.stability, EVIDENCE[attrs.evidence]].filter(Boolean).join(", ");
  return { true: "stable", false: "unstable" }[String(stable)] ?? null;
}

function rows(orbit, view) {
  const { attrs } = orbit, found = [];
  const stability = stabilityOf(orbit), attracts = !attrs.stability || attrs.stability === "attracts";
  const unit = `${view.model.period}${attrs.period === 1 ? "" : "s"}`;
  if (attrs.period) found.push(["Period", `${attrs.period} ${unit}`]);
  else if (attrs.period === null) found.push(["Period", "none found"]);
  if (attrs.kind) found.push(["Kind", attrs.kind]);
  if (stability) found.push(["Stability", stability]);
  if (attrs.motion) found.push(["Motion", attrs.motion]);
  if (attrs.status) found.push(["Status", String(attrs.status)]);
  if (attrs.attractor !== null && attrs.attractor !== undefined) found.push([attracts ? "Attractor" : "Set", attractorName(attrs.attractor, view)]);
  const told = attracts ? share(attrs) : null;
  if (told) found.push(["Share of the starts", told]);
  if (attrs.exponents?.length) {
    const from = attrs.exponents_from ? ` (from the ${attrs.exponents_from})` : "";
    found.push([`Lyapunov exponents [1/${view.model.time}]`, attrs.exponents.map((value) => number(value, 3)).join(", ") + from]);
  }
  return found;
}

/** An attractor's name as the diagram's legend has it. */
export function attractorName(id, view) {
  const entry = view.colours?.find((colour) => colour.name === "attractor");
  return entry?.categories.find((category) => category.id === id)?.label ?? String(id);
}

function parameterRows(orbit, view) {
  const { attrs } = orbit, found = [];
  const swept = new Set(view.axes.flatMap((axis) => [axis.name, axis.parameter]));
  if (attrs.frequency !== null && attrs.frequency !== undefined) found.push(["frequency [Hz]", number(attrs.frequency, 7), true]);
  for (const parameter of view.model.parameters) {
    const value = attrs.parameters?.[parameter.name];
    if (value !== undefined && value !== null) found.push([withUnit(parameter), number(value, 6), swept.has(parameter.name)]);
  }
  return found.sort((a, b) => Number(b[2]) - Number(a[2]));
}

function list(pairs) {
  const dl = el("dl", { class: "facts" });
  for (const [name, value] of pairs) dl.append(el("dt", { text: name }), el("dd", { text: value }));
  return dl;
}

function seeds(orbit, view) {
  const all = orbit.attrs.seeds ?? [];
  if (!all.length) return null;
  const items = all.slice(0, 12).map((seed) => {
    const parts = view.model.states.filter((state) => state.name in seed).map((state) => `${state.label || state.name} = ${number(seed[state.name], 3)}`);
    return el("li", { text: [seed.label, parts.join(", ")].filter(Boolean).join(": ") });
  });
  const more = all.length > 12 ? el("p", { class: "note", text: `and ${all.length - 12} more` }) : null;
  return el("details", {}, el("summary", { text: `Starts that lead here: ${all.length}` }), el("ul", {}, ...items), more);
}

/** Fill an element with what is known of an orbit. */
export function showFacts(body, orbit, view) {
  const parameters = parameterRows(orbit, view), shown = parameters.filter((row) => row[2]), rest = parameters.filter((row) => !row[2]);
  const note = orbit.attrs.note ? el("p", { class: "note", text: orbit.attrs.note }) : null;
  const children = [list([...shown, ...rows(orbit, view)]), note, seeds(orbit, view)];
  if (rest.length) children.push(el("details", {}, el("summary", { text: `All other parameters: ${rest.length}` }), list(rest)));
  body.replaceChildren(...children.filter(Boolean));
}
