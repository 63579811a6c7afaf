// What is known of a plane of initial states: labels on a grid, or single starts; and its picture.

import { extent } from "./frame.js";

/** What a plane holds: a grid of labels or single starts, and the box that they fill. */
export function mapOf({ attrs, arrays }, box = null) {
  const { u, v, label, starts, start_label: ids } = arrays;
  const common = { states: attrs.states, fixed: attrs.fixed ?? {}, labels: attrs.labels ?? [], source: attrs.source };
  if (attrs.source && label?.length) return { ...common, u, v, label, box: box ?? [...edges(u), ...edges(v)] };
  if (!ids?.length) return null;
  const [su, sv] = [0, 1].map((k) => Array.from(ids, (_, i) => starts[2 * i + k]));
  return { ...common, u: su, v: sv, dots: Array.from(ids), box: [...widened(su), ...widened(sv)] };
}

/** Id at a place of a grid of labels; null beyond it. */
export function idAt({ u, v, label, box: [x0, x1, y0, y1] }, x, y) {
  const i = Math.floor(((x - x0) / (x1 - x0)) * u.length), j = Math.floor(((y - y0) / (y1 - y0)) * v.length);
  return i < 0 || j < 0 || i >= u.length || j >= v.length ? null : label[j * u.length + i];
}

function widened(values) {
  const [low, high] = extent(values), room = 0.08 * (high - low) || 0.5;
  return [low - room, high + room];
}

/** Outer bounds of cells whose centres these are. */
function edges(values) {
  const n = values.length, first = values[0], last = values[n - 1];
  const half = n > 1 ? (last - first) / (n - 1) / 2 : 0.5;
  return [first - half, last + half];
}

/** Labels as colours, one pixel each; where there is none yet, what is `below` shines through. */
export function imageOf({ u, v, label, labels }, below = null) {
  const [nu, nv] = [u.length, v.length];
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [nu, nv];
  const ctx = canvas.getContext("2d");
  ctx.imageSmoothingEnabled = false;
  if (below) ctx.drawImage(below, 0, 0, nu, nv);
  const image = ctx.getImageData(0, 0, nu, nv);
  const colours = new Map(labels.map((entry) => [entry.id, [1, 3, 5].map((k) => parseInt(entry.colour.slice(k, k + 2), 16))]));
  for (let j = 0; j < nv; j++) {
    for (let i = 0; i < nu; i++) {
      const colour = colours.get(label[j * nu + i]);
      if (colour) image.data.set([...colour, 255], 4 * ((nv - 1 - j) * nu + i));
    }
  }
  ctx.putImageData(image, 0, 0);
  return canvas;
}
