// A copy in a folder on any static host: the cube itself, read column by column, each object compared with
// its sha256. The page holds the digest of the list of digests.

import { get, open, root, slice, withConsolidatedMetadata } from "zarrita";
import { gunzip } from "./export-data.js";
import { ExportSource } from "./source-export.js";
import { SourceError } from "./source-error.js";

const CUBE = "cube.zarr/";
const LIST = "objects.json";
/** Points of a diagram that are read at once; of a larger one, the columns in view. */
const MOST_AT_ONCE = 2_000_000;

const UNVERIFIED = "The objects of this copy are not compared with their checksums: the browser does that over https or on localhost only.";
const BY_CLICK = "Browsers let no file read others, so this folder does not open by a double click: put it on a web server (here: python3 -m http.server), or export one file instead.";
const VERIFIED = "Every object is compared with its sha256 when it is read.";

async function sha256(bytes) {
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Files beside the page by name, compared with their digests where the browser can. */
class Objects {
  constructor(digest) {
    this.digest = digest;
    this.verifies = Boolean(globalThis.crypto?.subtle);
    this.listed = null;
  }

  async fetched(name, entry) {
    let answer;
    try {
      answer = await fetch(name.split("/").map(encodeURIComponent).join("/"));
    } catch {
      if (location.protocol === "file:") throw new SourceError(BY_CLICK);
      throw new SourceError(`${name} cannot be read: the host does not answer.`, true);
    }
    if (!answer.ok) throw new SourceError(`${name} cannot be read: the host answers with ${answer.status}. Was all of the folder uploaded?`);
    const bytes = new Uint8Array(await answer.arrayBuffer());
    if (this.verifies && (await sha256(bytes)) !== entry) {
      throw new SourceError(`${name} is damaged: it is not what was exported, by its sha256. Upload the folder again.`);
    }
    return bytes;
  }

  async list() {
    this.listed ??= this.fetched(LIST, this.digest).then(
      (bytes) => JSON.parse(new TextDecoder().decode(bytes)),
      (error) => {
        this.listed = null;
        throw error;
      },
    );
    return this.listed;
  }

  /** Content of a file; undefined of one that was not exported. */
  async read(name) {
    const entry = (await this.list())[name];
    return entry === undefined ? undefined : this.fetched(name, entry.sha256);
  }
}

/** The cube as zarrita reads it. */
class CubeStore {
  constructor(objects) {
    this.objects = objects;
  }

  get(key) {
    return this.objects.read(CUBE + key.slice(1));
  }
}

export class FolderSource extends ExportSource {
  constructor(digest) {
    super();
    this.objects = new Objects(digest);
    this.parts = new Map();
  }

  async begin() {
    const view = await super.begin();
    this.notice = `${this.notice} ${this.objects.verifies ? VERIFIED : UNVERIFIED}`;
    const store = await withConsolidatedMetadata(new CubeStore(this.objects), { format: "v3" });
    this.group = root(store);
    return view;
  }

  async object(name) {
    const bytes = await this.objects.read(`data/${name}.bin`);
    if (bytes === undefined) throw new SourceError(`This copy has no ${name}.`);
    return gunzip(bytes);
  }

  needsWindow() {
    return this.cells.count * this.described.n_keep > MOST_AT_ONCE;
  }

  /** Part of an array of the cube: ranges on the dims of the cells, then what `own` says of its own dims. */
  part(name, ranges, own) {
    const key = JSON.stringify([name, ranges, own]);
    if (!this.parts.has(key)) {
      this.parts.set(key, this.readPart(name, ranges, own).catch((error) => {
        this.parts.delete(key);
        throw asSourceError(error);
      }));
      // what was looked at longest ago goes first
      if (this.parts.size > 64) this.parts.delete(this.parts.keys().next().value);
    }
    return this.parts.get(key);
  }

  async readPart(name, ranges, own) {
    const array = await open.v3(this.group.resolve(name), { kind: "array" });
    const places = [...ranges.map(([first, end]) => slice(first, end)), ...own.map((k) => (k === null ? null : slice(k, k + 1)))];
    return get(array, places);
  }

  /** Places in a part of the selected cells. */
  places({ cell, ranges }, { stride }) {
    const { dims, strides } = this.cells, found = new Uint32Array(cell.length);
    for (let i = 0; i < cell.length; i++) {
      let place = 0;
      for (let d = 0; d < dims.length; d++) place += ((Math.floor(cell[i] / strides[d]) % dims[d].size) - ranges[d][0]) * stride[d];
      found[i] = place;
    }
    return found;
  }

  async column(y, selection) {
    const { variable, own } = this.about.columns[y];
    const [part, { status }] = await Promise.all([this.part(variable, selection.ranges, own), this.layers(selection)]);
    const { data, stride, shape } = part, places = this.places(selection, part), drawn = new Set(this.about.drawn);
    const axis = this.cells.dims.length + own.indexOf(null), n = shape[axis], step = stride[axis];
    const first = new Uint32Array(places.length + 1), values = new Float64Array(places.length * n);
    let count = 0;
    for (let i = 0; i < places.length; i++) {
      if (drawn.has(status[i])) {
        for (let k = 0; k < n; k++) {
          const value = data[places[i] + k * step];
          if (Number.isFinite(value)) values[count++] = value;
        }
      }
      first[i + 1] = count;
    }
    return { first, y: values.slice(0, count) };
  }

  async layers(selection) {
    const names = ["status", ...this.described.colours.map((colour) => `colour_${colour.name}`)], found = {};
    await Promise.all(names.map(async (name) => {
      const part = await this.part(name, selection.ranges, []), places = this.places(selection, part);
      found[name] = part.data.constructor.from(places, (place) => part.data[place]);
    }));
    return found;
  }
}

/** zarrita wraps what a store has thrown: the sentence is for a reader. */
function asSourceError(error) {
  for (let cause = error; cause; cause = cause.cause) if (cause instanceof SourceError) return cause;
  return new SourceError(`The cube cannot be read: ${error.message}`);
}
