// The diagram with its curves and legend as one picture.

import { FONT, boxOf } from "./axes.js";
import { visible } from "./palette.js";
import { pictureOf } from "./picture.js";
import { theme } from "./theme.js";

const LINE = 20;

/** Make the picture of what the page shows on the left. */
export function pictureOfView({ diagram, curves, state, view }, format) {
  const colours = theme(), { width } = diagram, strips = curves.shown;
  const entries = legendOf(view, state.get(), width);
  const head = 12 + LINE * entries.rows, height = head + diagram.height + strips.reduce((sum, strip) => sum + strip.height + 8, 0);
  const paint = async (ctx) => {
    ctx.font = FONT;
    paintLegend(ctx, entries, colours);
    ctx.translate(0, head);
    await diagram.paintPicture(ctx, colours, format === "svg");
    let top = diagram.height + 8;
    for (const strip of strips) {
      ctx.translate(0, top);
      strip.paint(ctx, boxOf(strip.width, strip.height, { foot: 6, top: 6 }), colours);
      top = strip.height + 8;
    }
  };
  return pictureOf(width, height, paint, format, colours.card);
}

function legendOf(view, { colour, hidden }, width) {
  const colouring = view.colours.find(({ name }) => name === colour), placed = [];
  let [x, row] = [12, 0];
  for (const { id, label, colour: hex } of colouring?.categories ?? []) {
    if ((hidden[colour] ?? []).includes(id)) continue;
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
