// Colours of points: those of the figures, brought to a contrast that can be seen on the page's paper.

/** "#rrggbb" as three numbers. */
export function rgbOf(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

function hexOf(rgb) {
  return `#${rgb.map((part) => Math.round(part).toString(16).padStart(2, "0")).join("")}`;
}

/** Relative luminance as the guidelines on accessible content (WCAG 2.2) define it. */
export function luminance(rgb) {
  const [r, g, b] = rgb.map((part) => (part / 255 <= 0.04045 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}

/** Contrast of two colours, 1 to 21. */
export function contrast(a, b) {
  const [low, high] = [luminance(a), luminance(b)].sort((p, q) => p - q);
  return (high + 0.05) / (low + 0.05);
}

/** Any colour of a style sheet that canvases know, as three numbers. */
export function parsed(colour) {
  if (/^#[0-9a-f]{6}$/i.test(colour)) return rgbOf(colour);
  const ctx = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  ctx.fillStyle = colour;
  ctx.fillRect(0, 0, 1, 1);
  return [...ctx.getImageData(0, 0, 1, 1).data.slice(0, 3)];
}

const LEAST = { onLight: 2.1, onDark: 3 };

/**
 * A colour as it is on a paper: darker on a light one, lighter on a dark one, if it could not be told from it.
 * @param {string} hex
 * @param {string} paper
 */
export function visible(hex, paper) {
  const ground = parsed(paper), isDark = luminance(ground) < 0.2;
  const goal = isDark ? 255 : 0, least = isDark ? LEAST.onDark : LEAST.onLight;
  let rgb = rgbOf(hex);
  for (let k = 0; k < 40 && contrast(rgb, ground) < least; k++) rgb = rgb.map((part) => part + 0.08 * (goal - part));
  return hexOf(rgb);
}

/** Grey of points of no category, and the colour of all where they are not told apart. */
const NONE = "#7f7f7f", ALL = "#0072b2";

/**
 * Bytes red, green, blue, 255 of each cell; all 0 for one that is switched off.
 * @param {Uint16Array|null} codes category of each cell, 65535 for none
 * @param {number} count of cells
 * @param {{categories: {id: number, colour: string}[]}|null} colouring
 * @param {number[]} hidden ids that are switched off; -1 for cells of no category
 * @param {string} paper
 */
export function bytesOf(codes, count, colouring, hidden, paper) {
  const bytes = new Uint8Array(4 * count), words = new Uint32Array(bytes.buffer);
  const word = (hex) => {
    const [r, g, b] = rgbOf(visible(hex, paper));
    return (r | (g << 8) | (b << 16) | (255 << 24)) >>> 0;
  };
  const table = new Map((colouring?.categories ?? []).map(({ id, colour }) => [id, hidden.includes(id) ? 0 : word(colour)]));
  const other = hidden.includes(-1) ? 0 : word(colouring ? NONE : ALL);
  for (let i = 0; i < count; i++) words[i] = codes ? (table.get(codes[i]) ?? other) : other;
  return bytes;
}
