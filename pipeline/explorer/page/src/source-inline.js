// A copy in one file: every object lies in the page itself, as base64 of gzip.

import { gunzip } from "./export-data.js";
import { ExportSource } from "./source-export.js";
import { SourceError } from "./source-error.js";

function decoded(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const characters = atob(text), bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

/** Of numbers of points: where each cell's begin. */
function starting({ arrays: { count, y } }) {
  const first = new Uint32Array(count.length + 1);
  for (let i = 0; i < count.length; i++) first[i + 1] = first[i] + count[i];
  return { first, y: y instanceof Float64Array ? y : Float64Array.from(y) };
}

export class InlineSource extends ExportSource {
  constructor(page) {
    super();
    this.page = page;
    this.columns = new Map();
  }

  async object(name) {
    const element = this.page.getElementById(`data-${name}`);
    if (!element) throw new SourceError(`This file is not whole: it has no ${name}.`);
    try {
      return await gunzip(decoded(element.textContent.trim()));
    } catch {
      throw new SourceError(`This file is damaged: its ${name} cannot be read.`);
    }
  }

  /** Where the points of every cell begin, and the points. */
  values(y) {
    if (!this.columns.has(y)) this.columns.set(y, this.packed(this.about.columns[y]).then(starting));
    return this.columns.get(y);
  }

  async column(y, { cell }) {
    const all = await this.values(y), first = new Uint32Array(cell.length + 1);
    for (let i = 0; i < cell.length; i++) first[i + 1] = first[i] + all.first[cell[i] + 1] - all.first[cell[i]];
    const values = new Float64Array(first[cell.length]);
    for (let i = 0; i < cell.length; i++) values.set(all.y.subarray(all.first[cell[i]], all.first[cell[i] + 1]), first[i]);
    return { first, y: values };
  }

  async layers({ cell }) {
    const { arrays } = await this.packed("cells"), found = {};
    for (const [name, values] of Object.entries(arrays)) {
      found[name] = new values.constructor(cell.length);
      for (let i = 0; i < cell.length; i++) found[name][i] = values[cell[i]];
    }
    return found;
  }
}
