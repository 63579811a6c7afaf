// Angles on a circle of which only full turns are lost: lines broken where they leave one side and come in
// on the other, so that none is drawn across the picture.

const TURN = 2 * Math.PI;

/**
 * How values of a state are shown: as they are, shifted by full turns, or cut at half turns.
 * @param {ArrayLike<number>} values
 * @param {boolean} isAngle
 * @returns {{shift: number, cut: boolean}}
 */
export function wrappingOf(values, isAngle) {
  if (!isAngle || values.length === 0) return { shift: 0, cut: false };
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < values.length; i++) {
    if (values[i] < low) low = values[i];
    if (values[i] > high) high = values[i];
  }
  if (!(high - low < TURN)) return { shift: 0, cut: true };
  return { shift: -TURN * Math.round((low + high) / 2 / TURN), cut: false };
}

/** Where a single value is shown under a wrapping; `near` is what an uncut angle is brought next to. */
export function wrapped(value, wrapping, isAngle = false, near = 0) {
  if (wrapping.cut) return value - TURN * Math.floor((value + Math.PI) / TURN);
  const shifted = value + wrapping.shift;
  return isAngle ? shifted - TURN * Math.round((shifted - near) / TURN) : shifted;
}

function cuts(a, b) {
  const first = Math.floor((a + Math.PI) / TURN), last = Math.floor((b + Math.PI) / TURN);
  const found = [];
  for (let k = Math.min(first, last) + 1; k <= Math.max(first, last); k++) {
    found.push((TURN * k - Math.PI - a) / (b - a));
  }
  return found;
}

function turnsAt(value, wrapping) {
  return wrapping.cut ? -TURN * Math.floor((value + Math.PI) / TURN) : wrapping.shift;
}

/**
 * Lines through points, broken at the edges of angles that are cut.
 * @param {ArrayLike<number>} x
 * @param {ArrayLike<number>} y
 * @param {{shift: number, cut: boolean}} wx
 * @param {{shift: number, cut: boolean}} wy
 * @returns {Array<number[]>} each x0, y0, x1, y1, ...
 */
export function brokenLines(x, y, wx, wy) {
  const lines = [];
  let line = [];
  for (let i = 0; i + 1 < x.length; i++) {
    if (!Number.isFinite(x[i] + y[i] + x[i + 1] + y[i + 1])) {
      if (line.length > 2) lines.push(line);
      line = [];
      continue;
    }
    const dx = x[i + 1] - x[i], dy = y[i + 1] - y[i];
    let at = [0, 1];
    if (wx.cut) at = at.concat(cuts(x[i], x[i + 1]));
    if (wy.cut) at = at.concat(cuts(y[i], y[i + 1]));
    at.sort((a, b) => a - b);
    for (let k = 0; k + 1 < at.length; k++) {
      const s = at[k], e = at[k + 1], middle = (s + e) / 2;
      const tx = turnsAt(x[i] + middle * dx, wx), ty = turnsAt(y[i] + middle * dy, wy);
      if (k > 0 || line.length === 0) {
        if (line.length > 2) lines.push(line);
        line = [x[i] + s * dx + tx, y[i] + s * dy + ty];
      }
      line.push(x[i] + e * dx + tx, y[i] + e * dy + ty);
    }
  }
  if (line.length > 2) lines.push(line);
  return lines;
}
