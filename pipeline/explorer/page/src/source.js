// Where the page's numbers come from: a run that is open in magpend, which a transport asks.

import { unpackArrays } from "./arrays.js";
import { LiveClient } from "./live.js";

/** Arguments of a request: `at` and what else there is by their names, nothing that is null. */
function wordsOf(values) {
  const words = {};
  for (const [key, value] of Object.entries(values)) {
    if (value === null || value === undefined) continue;
    if (key === "at") for (const [axis, index] of Object.entries(value)) words[`at.${axis}`] = String(index);
    else words[key] = String(value);
  }
  return words;
}

export class RunSource {
  /** @param {{ask: function, connect: function}} transport see transport.js */
  constructor(transport) {
    this.transport = transport;
    this.live = null;
    this.notice = null;
    this.formats = ["csv", "nc"];
    this.described = null;
  }

  /** Connect to what computes while one watches, if the run has it. */
  async begin() {
    const view = await this.view().catch(() => null);
    if (view?.live) this.live = new LiveClient((hears) => this.transport.connect(hears));
    return this;
  }

  async packed(name, values) {
    return unpackArrays((await this.transport.ask(name, wordsOf(values))).content);
  }

  async json(name, values = {}) {
    return JSON.parse(textOf(await this.transport.ask(name, wordsOf(values))));
  }

  /** What the run is; asked once. */
  async view() {
    this.described ??= this.json("view").catch((error) => {
      this.described = null;
      throw error;
    });
    return this.described;
  }

  diagram({ x, y, at }) {
    return this.packed("diagram", { x, y, at });
  }

  curves({ x, at }) {
    return this.json("curves", { x, at });
  }

  branches({ x, y, at }) {
    return this.json("branches", { x, y, at });
  }

  /** Events of attractors along the horizontal axis. */
  events({ x, at }) {
    return this.json("events", { x, at });
  }

  /** The orbit at the bifurcation of an event. */
  eventOrbit({ x, at, event }) {
    return this.packed("event-orbit", { x, at, event });
  }

  orbit({ cell, point }) {
    return this.packed("orbit", { cell, point });
  }

  plane({ at }) {
    return this.packed("plane", { at });
  }

  /** Bifurcation curves in the plane of two parameters, over the run's map if it has one. */
  parameterPlane() {
    return this.json("parameter-plane");
  }

  /** The orbit at a point of a bifurcation curve. */
  curveOrbit({ curve, point }) {
    return this.packed("curve-orbit", { curve, point });
  }

  attractors({ at }) {
    return this.json("attractors", { at });
  }

  /** Critical shocks and edge states at a place of the axes. */
  disturbances({ at }) {
    return this.json("disturbances", { at });
  }

  /** Data of a view to keep: a Blob of CSV or NetCDF. */
  async table(kind, query, format) {
    const { content, kind: type } = await this.transport.ask("table", wordsOf({ view: kind, format, ...query }));
    return new Blob([content], { type });
  }

  /** Specification of a run of a region: TOML. */
  async zoom(region) {
    return textOf(await this.transport.ask("zoom", {}, JSON.stringify(region)));
  }
}

function textOf({ content }) {
  return new TextDecoder().decode(content);
}
