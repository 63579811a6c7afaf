// Branches of orbits and their bifurcations over the points of a diagram.

import { placeX, placeY } from "./axes.js";

const SHAPES = ["circle", "square", "diamond", "triangle"];

/** Shape of the mark of each kind of bifurcation, in the order in which kinds appear. */
export function shapesOf(points) {
  const kinds = [...new Set(points.map((point) => point.kind))];
  return new Map(kinds.map((kind, k) => [kind, SHAPES[k % SHAPES.length]]));
}

/** Bounds widened so that they hold all branches and bifurcations, with some room beyond these. */
export function holding(bounds, found) {
  const ends = [bounds.slice(0, 2), bounds.slice(2)];
  const take = (k, value) => {
    if (value !== null && Number.isFinite(value)) ends[k] = [Math.min(ends[k][0], value), Math.max(ends[k][1], value)];
  };
  const curves = [...(found?.branches ?? []).flatMap((branch) => branch.segments), ...(found?.points ?? []).map(({ x, y }) => ({ x: y.map(() => x), y }))];
  for (const { x, y } of curves) {
    for (let i = 0; i < x.length; i++) {
      if (y[i] === null) continue;
      take(0, x[i]);
      take(1, y[i]);
    }
  }
  return ends.flatMap(([low, high], k) => {
    const [first, last] = bounds.slice(2 * k, 2 * k + 2), room = 0.03 * (high - low);
    return [low < first ? low - room : first, high > last ? high + room : last];
  });
}

/**
 * Paint branches: solid where stable, dashed where not. The stable ones lie under the points, which tell where
 * orbits were found, by whom they are reached; the others over them.
 * @param {CanvasRenderingContext2D} ctx
 * @param {Object} box
 * @param {number[]} bounds
 * @param {{branches: Object[], points: Object[]}} found of api/branches
 * @param {Object} colours
 * @param {boolean} stable which of them
 */
export function paintBranches(ctx, box, bounds, found, colours, stable) {
  ctx.lineJoin = "round";
  ctx.beginPath();
  for (const branch of found.branches) {
    for (const segment of branch.segments) if (segment.stable === stable) trace(ctx, box, bounds, segment);
  }
  ctx.setLineDash(stable ? [] : [5, 4]);
  ctx.strokeStyle = colours.ink;
  ctx.lineWidth = 1.2;
  ctx.stroke();
  ctx.setLineDash([]);
}

function trace(ctx, box, bounds, { x, y }) {
  let pen = false;
  const [x0, x1] = bounds, room = x1 - x0;
  for (let i = 0; i < x.length; i++) {
    if (y[i] === null || x[i] < x0 - room || x[i] > x1 + room) {
      pen = false;
      continue;
    }
    const px = placeX(box, bounds, x[i]), py = placeY(box, bounds, y[i]);
    if (pen) ctx.lineTo(px, py);
    else ctx.moveTo(px, py);
    pen = true;
  }
}

/** Paint a mark at each bifurcation, with its label where there is room. */
export function paintBifurcations(ctx, box, bounds, { points }, colours) {
  const shapes = shapesOf(points), taken = [];
  ctx.lineWidth = 1.5;
  ctx.textBaseline = "bottom";
  for (const point of points) {
    const px = placeX(box, bounds, point.x);
    if (px < box.left || px > box.left + box.width) continue;
    for (const [k, y] of point.y.entries()) {
      const py = placeY(box, bounds, y);
      if (py < box.top || py > box.top + box.height) continue;
      mark(ctx, shapes.get(point.kind), px, py, 4);
      ctx.fillStyle = colours.card;
      ctx.fill();
      ctx.strokeStyle = colours.ink;
      ctx.stroke();
      if (k === 0) label(ctx, box, point.label ?? point.kind, px, py, taken, colours);
    }
  }
}

/** Path of a mark about a place. */
export function mark(ctx, shape, x, y, r) {
  ctx.beginPath();
  if (shape === "circle") ctx.arc(x, y, r, 0, 2 * Math.PI);
  else if (shape === "square") ctx.rect(x - r, y - r, 2 * r, 2 * r);
  else {
    const corners = shape === "diamond" ? [[0, -1.3], [1.3, 0], [0, 1.3], [-1.3, 0]] : [[0, -1.3], [1.2, 1], [-1.2, 1]];
    corners.forEach(([dx, dy], k) => (k ? ctx.lineTo(x + dx * r, y + dy * r) : ctx.moveTo(x + dx * r, y + dy * r)));
    ctx.closePath();
  }
}

// a label that would lie over another is left out: it comes when one zooms in, and with the pointer
function label(ctx, box, text, px, py, taken, colours) {
  const width = ctx.measureText(text).width, x = Math.min(px + 6, box.left + box.width - width - 2), y = Math.max(py - 5, box.top + 16);
  if (taken.some(([a, b, w]) => x < a + w + 4 && a < x + width + 4 && Math.abs(b - y) < 16)) return;
  taken.push([x, y, width]);
  ctx.globalAlpha = 0.8;
  ctx.fillStyle = colours.card;
  ctx.fillRect(x - 2, y - 14, width + 4, 15);
  ctx.globalAlpha = 1;
  ctx.fillStyle = colours.ink;
  ctx.textAlign = "left";
  ctx.fillText(text, x, y);
}

/** The bifurcation at a place, within some pixels. */
export function bifurcationAt(box, bounds, points, px, py, reach = 8) {
  for (const point of points) {
    for (const y of point.y) {
      if (Math.hypot(placeX(box, bounds, point.x) - px, placeY(box, bounds, y) - py) <= reach) return point;
    }
  }
  return null;
}
