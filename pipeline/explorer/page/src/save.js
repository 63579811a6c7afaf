// What a panel shows, to keep: its picture as SVG or PNG, its data as CSV or NetCDF.

import { el } from "./dom.js";
import { download, savePicture } from "./picture.js";
import { theme } from "./theme.js";

/**
 * A menu of a panel.
 * @param {Object} what
 * @param {string} what.title of the panel, for readers of a screen
 * @param {function(): string} what.name of the files, without their suffix
 * @param {function(): Frame[]} [what.frames] the pictures, drawn below each other
 * @param {{kind: string, query: function(): Object}} [what.data] the table of the source
 * @param {Object} what.source
 */
export function saveMenu({ title, name, frames, data, source }) {
  const told = el("span", { class: "note", role: "status" });
  const doing = (work) => async () => {
    told.textContent = "";
    try {
      await work();
    } catch (error) {
      told.textContent = error.message;
    }
  };
  const button = (text, work) => el("button", { type: "button", text, "aria-label": `${title}: save as ${text}`, on: { click: doing(work) } });
  const buttons = [];
  if (frames) for (const format of ["svg", "png"]) buttons.push(button(format.toUpperCase(), () => saveFrames(name(), frames(), format)));
  if (data) {
    const kinds = [["csv", "CSV"], ["nc", "NetCDF"]];
    for (const [format, text] of kinds) {
      buttons.push(button(text, async () => download(`${name()}.${format}`, await source.table(data.kind, data.query(), format))));
    }
  }
  return el("details", { class: "save" }, el("summary", { text: "Save", "aria-label": `Save: ${title}` }), el("div", { class: "controls" }, ...buttons, told));
}

/** Save pictures below each other as one file. */
async function saveFrames(name, frames, format) {
  const shown = frames.filter((frame) => frame.width > 0 && !frame.element.hidden);
  const width = Math.max(...shown.map((frame) => frame.width)), height = shown.reduce((sum, frame) => sum + frame.height, 0);
  const paint = (ctx) => {
    let top = 0;
    for (const frame of shown) {
      ctx.save();
      ctx.translate(0, top);
      frame.paintInto(ctx);
      ctx.restore();
      top += frame.height;
    }
  };
  await savePicture(name, width, height, paint, format, theme().card);
}
