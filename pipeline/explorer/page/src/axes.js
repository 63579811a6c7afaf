// Axes of a picture: round numbers between two bounds, written so that they can be told apart however far one
// has zoomed in, and the frame with its labels.

export const FONT = "12px system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif";

const MINUS = "\u2212";
const RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹";

/** A whole number as an exponent above the line. */
export function raised(power) {
  return String(power).replace("-", "⁻").replace(/\d/g, (digit) => RAISED[digit]);
}

/** Unit with its powers raised: m/s2 as m/s². */
export function niceUnit(unit) {
  return unit === "1" ? "" : (unit ?? "").replace(/(?<=[A-Za-z])[23]/g, (digit) => RAISED[digit]);
}

function signed(text) {
  return text.replace("-", MINUS);
}

/** Round step of some `count` in a span: its mantissa 1, 2 or 5 and its power of ten. */
function stepOf(span, count) {
  const power = Math.floor(Math.log10(span / count));
  for (const [m, p] of [[1, power], [2, power], [5, power]]) if (span / (m * 10 ** p) <= count) return [m, p];
  return [1, power + 1];
}

/** i steps of m 10^p, correctly rounded: 3 times 1e-1 is 0.3. */
function multiple(i, m, p) {
  return p < 0 ? (i * m) / 10 ** -p : i * m * 10 ** p;
}

/**
 * Ticks of an axis.
 * @param {number} low
 * @param {number} high
 * @param {number} count most of them
 * @returns {{ticks: {value: number, text: string}[], offset: number, power: number}} the number at a tick is
 *   offset + text · 10^power
 */
export function ticksOf(low, high, count) {
  const none = { ticks: [], offset: 0, power: 0 };
  const span = high - low, size = Math.max(Math.abs(low), Math.abs(high));
  if (!(span > 0) || !Number.isFinite(span) || span < 4e-16 * size) return none;
  const [m, p] = stepOf(span, Math.max(2, count));
  const first = Math.ceil(low / multiple(1, m, p) - 1e-9), values = [];
  for (let i = first; values.length <= count + 1; i++) {
    const value = multiple(i, m, p);
    if (value > high + 1e-9 * span) break;
    values.push([i, value]);
  }
  const leading = Math.floor(Math.log10(size));
  if (leading - p > 5) return fromOffset(values, m, p, low, span);
  const power = leading >= 5 || p < -5 ? leading : 0;
  const digits = Math.max(0, power - p);
  const ticks = values.map(([, value]) => ({ value, text: signed(zeroed((value / 10 ** power).toFixed(digits))) }));
  return { ticks, offset: 0, power };
}

function zeroed(text) {
  return /^-0\.?0*$/.test(text) ? text.slice(1) : text;
}

// deep in a zoom: the digits that all ticks share are said once
function fromOffset(values, m, p, low, span) {
  const q = Math.ceil(Math.log10(span)) + 1;
  const base = Math.floor(low / multiple(1, 1, q)), offset = multiple(base, 1, q);
  const shared = Math.round(offset / multiple(1, m, p));
  const ticks = values.map(([i, value]) => ({ value, text: signed(String((i - shared) * m)) }));
  return { ticks, offset, power: p, digits: Math.max(0, -q) };
}

/** Ticks at parts of π, for an angle that spans a good part of a turn; else as `ticksOf`. */
export function angleTicks(low, high, count) {
  if (high - low < 2) return ticksOf(low, high, count);
  const parts = [[1, 8], [1, 4], [1, 2], [1, 1], [2, 1], [4, 1], [8, 1], [16, 1], [64, 1], [256, 1]];
  const part = parts.find(([n, d]) => (high - low) / ((Math.PI * n) / d) <= count);
  if (!part) return ticksOf(low, high, count);
  const [n, d] = part, step = (Math.PI * n) / d, ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9; k++) ticks.push({ value: k * step, text: partOfPi(k * n, d) });
  return { ticks, offset: 0, power: 0 };
}

function partOfPi(k, d) {
  if (k === 0) return "0";
  let n = Math.abs(k);
  while (d > 1 && n % 2 === 0) [n, d] = [n / 2, d / 2];
  return `${k < 0 ? MINUS : ""}${n === 1 ? "" : n}π${d === 1 ? "" : `/${d}`}`;
}

/** Label of an axis with its unit, and what its ticks leave out. */
export function labelOf({ label, unit }, { offset, power, digits }) {
  const shown = niceUnit(unit), scale = power ? `10${raised(power)}` : "";
  const name = offset ? `${label} ${offset < 0 ? "+" : MINUS} ${Math.abs(offset).toFixed(digits ?? 0)}` : label;
  const inside = [scale, shown].filter(Boolean).join("\u00a0");
  return inside ? `${name} [${inside}]` : name;
}

/** A number for reading: as many digits as a window of that span tells apart, and some more. */
export function told(value, span = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const needed = span > 0 && size > 0 ? Math.ceil(Math.log10(size / span)) + 4 : 5;
  const digits = Math.min(16, Math.max(5, needed));
  if (size !== 0 && (size >= 1e7 || size < 1e-4)) {
    const [mantissa, power] = value.toExponential(digits - 1).split("e");
    return `${signed(trimmed(mantissa))}·10${raised(Number(power))}`;
  }
  return signed(trimmed(value.toPrecision(digits)));
}

function trimmed(text) {
  return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}

/** Where a picture's axes are: the room around them is the same in all pictures above each other. */
export function boxOf(width, height, { foot = 44, top = 12 } = {}) {
  const left = width < 560 ? 60 : 68, right = width < 560 ? 10 : 16;
  return { left, top, width: Math.max(20, width - left - right), height: Math.max(20, height - top - foot) };
}

/** Place of a value on the picture. */
export function placeX(box, [x0, x1], x) {
  return box.left + ((x - x0) / (x1 - x0)) * box.width;
}

export function placeY(box, [, , y0, y1], y) {
  return box.top + ((y1 - y) / (y1 - y0)) * box.height;
}

/** Ticks of an axis that shows its values times its factor, such as frequencies as omega. */
function ticksAlong({ angle, factor = 1 }, low, high, most) {
  const found = (angle ? angleTicks : ticksOf)(low * factor, high * factor, most);
  return { ...found, ticks: found.ticks.map(({ value, text }) => ({ value: value / factor, text })) };
}

/**
 * Paint a frame with grid, ticks and labels.
 * @param {CanvasRenderingContext2D} ctx
 * @param {Object} box from `boxOf`
 * @param {number[]} bounds x0, x1, y0, y1
 * @param {{x: Object, y: Object}} axes each {label, unit, angle, factor}; x without `label` has neither numbers nor label
 * @param {Object} colours from `theme`
 */
export function paintAxes(ctx, box, bounds, axes, colours) {
  const { left, top, width, height } = box;
  const xs = ticksAlong(axes.x, bounds[0], bounds[1], Math.max(2, Math.floor(width / 80)));
  const ys = ticksAlong(axes.y, bounds[2], bounds[3], Math.max(2, Math.floor(height / (height < 150 ? 22 : 44))));
  ctx.font = FONT;
  ctx.lineWidth = 1;
  ctx.strokeStyle = colours.grid;
  ctx.beginPath();
  for (const { value } of xs.ticks) line(ctx, Math.round(placeX(box, bounds, value)) + 0.5, top, 0, height);
  for (const { value } of ys.ticks) line(ctx, left, Math.round(placeY(box, bounds, value)) + 0.5, width, 0);
  ctx.stroke();
  ctx.fillStyle = colours.muted;
  ctx.textBaseline = "top";
  if (axes.x.label) {
    for (const { value, text } of xs.ticks) {
      const place = placeX(box, bounds, value), half = text.length * 3.4;
      ctx.textAlign = "center";
      if (place + half <= left + width + 14) ctx.fillText(text, place, top + height + 6);
    }
  }
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  for (const { value, text } of ys.ticks) ctx.fillText(text, left - 6, placeY(box, bounds, value));
  paintLabels(ctx, box, axes, xs, ys, colours);
}

function paintLabels(ctx, { left, top, width, height }, axes, xs, ys, colours) {
  ctx.fillStyle = colours.ink;
  ctx.textAlign = "center";
  ctx.textBaseline = "top";
  if (axes.x.label) ctx.fillText(labelOf(axes.x, xs), left + width / 2, top + height + 24);
  ctx.save();
  ctx.translate(4, top + height / 2);
  ctx.rotate(-Math.PI / 2);
  ctx.fillText(labelOf(axes.y, ys), 0, 0);
  ctx.restore();
}

function line(ctx, x, y, dx, dy) {
  ctx.moveTo(x, y);
  ctx.lineTo(x + dx, y + dy);
}

/** Paint the outline of the axes, over what is inside. */
export function paintFrame(ctx, { left, top, width, height }, colours) {
  ctx.strokeStyle = colours.line;
  ctx.lineWidth = 1;
  ctx.strokeRect(left + 0.5, top + 0.5, width - 1, height - 1);
}
