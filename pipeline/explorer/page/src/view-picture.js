// The diagram with its curves and legend as one picture.

import { FONT, boxOf } from "./axes.js";
import { visible } from "./palette.js";
import { pictureOf } from "./picture.js";
import { theme } from "./theme.js";

const LINE = 20;

/** Make the picture of what the page shows on the left. */
export function pictureOfView({ diagram, curves, state, view }, format) {
  const colours = theme(), { width } = diagram, strips = curves.shown;
  const entries = flowed(categoriesOf(view, state.get()), width);
  const names = strips.map((strip) => flowed(strip.curves.map(({ title, colour }) => ({ label: title, colour })), width));
  const rooms = names.map(({ rows }) => 12 + LINE * rows);
  const head = 12 + LINE * entries.rows;
  const height = strips.reduce((sum, strip, k) => sum + rooms[k] + strip.height, head + diagram.height + 8);
  const paint = async (ctx) => {
    ctx.font = FONT;
    paintLegend(ctx, entries, colours);
    ctx.translate(0, head);
    await diagram.paintPicture(ctx, colours, format === "svg");
    let above = diagram.height;
    for (const [k, strip] of strips.entries()) {
      ctx.translate(0, above);
      paintLegend(ctx, names[k], colours);
      ctx.translate(0, rooms[k]);
      strip.paint(ctx, boxOf(strip.width, strip.height, { foot: 6, top: 6 }), colours);
      above = strip.height;
    }
  };
  return pictureOf(width, height, paint, format, colours.card);
}

function categoriesOf(view, { colour, hidden }) {
  const colouring = view.colours.find(({ name }) => name === colour);
  return (colouring?.categories ?? []).filter(({ id }) => !(hidden[colour] ?? []).includes(id));
}

/** Entries of a legend, one after the other in rows. */
function flowed(entries, width) {
  const placed = [];
  let [x, row] = [12, 0];
  for (const { label, colour: hex } of entries) {
    const room = 32 + 6.6 * label.length;
    if (x > 12 && x + room > width) [x, row] = [12, row + 1];
    placed.push({ x, row, label, hex });
    x += room;
  }
  return { placed, rows: placed.length ? row + 1 : 0 };
}

function paintLegend(ctx, { placed }, colours) {
  ctx.textAlign = "left";
  ctx.textBaseline = "middle";
  for (const { x, row, label, hex } of placed) {
    const y = 14 + LINE * row;
    ctx.fillStyle = visible(hex, colours.card);
    ctx.fillRect(x, y - 5, 10, 10);
    ctx.fillStyle = colours.ink;
    ctx.fillText(label, x + 16, y);
  }
}
