// Where the page's numbers come from: a server on this machine.

import { unpackArrays } from "./arrays.js";

/** What went wrong, as one sentence for a reader; `lost` if no server answered. */
export class SourceError extends Error {
  constructor(message, lost = false) {
    super(message);
    this.lost = lost;
  }
}

/** Query of an address: `at` and `x` by their names, nothing that is null. */
function queryOf(values) {
  const query = new URLSearchParams();
  for (const [key, value] of Object.entries(values)) {
    if (value === null || value === undefined) continue;
    if (key === "at") for (const [axis, index] of Object.entries(value)) query.set(`at.${axis}`, index);
    else query.set(key, value);
  }
  const text = query.toString();
  return text ? `?${text}` : "";
}

export class ServerSource {
  /**
   * @param {string} token what lets this page in
   * @param {Object|null} live what computes while one watches
   */
  constructor(token, live = null) {
    this.token = token;
    this.live = live;
    this.notice = null;
    this.formats = ["csv", "nc"];
    this.described = null;
  }

  async ask(path, options = {}) {
    let answer;
    try {
      answer = await fetch(`api/${path}`, {
        cache: "no-store", credentials: "same-origin", redirect: "error", ...options,
        headers: { Authorization: `token ${this.token}`, ...options.headers },
      });
    } catch (cause) {
      if (cause.name === "AbortError") throw cause;
      throw new SourceError("The server does not answer. Was magpend explore stopped? Start it again, then press Try again.", true);
    }
    if (answer.ok) return answer;
    const told = await answer.json().then((body) => body.error, () => null);
    throw new SourceError(told ?? `The server answered with an error (${answer.status}).`);
  }

  async packed(path) {
    return unpackArrays(await (await this.ask(path)).arrayBuffer());
  }

  async json(path) {
    return (await this.ask(path)).json();
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
    return this.packed(`diagram${queryOf({ x, y, at })}`);
  }

  curves({ x, at }) {
    return this.json(`curves${queryOf({ x, at })}`);
  }

  branches({ x, y, at }) {
    return this.json(`branches${queryOf({ x, y, at })}`);
  }

  orbit({ cell, point }) {
    return this.packed(`orbit${queryOf({ cell, point })}`);
  }

  plane({ at }) {
    return this.packed(`plane${queryOf({ at })}`);
  }

  /** Bifurcation curves in the plane of two parameters, over the run's map if it has one. */
  parameterPlane() {
    return this.json("parameter-plane");
  }

  /** The orbit at a point of a bifurcation curve. */
  curveOrbit({ curve, point }) {
    return this.packed(`curve-orbit${queryOf({ curve, point })}`);
  }

  attractors({ at }) {
    return this.json(`attractors${queryOf({ at })}`);
  }

  /** Critical shocks and edge states at a place of the axes. */
  disturbances({ at }) {
    return this.json(`disturbances${queryOf({ at })}`);
  }

  /** Data of a view to keep: a Blob of CSV or NetCDF. */
  async table(kind, query, format) {
    return (await this.ask(`table${queryOf({ view: kind, format, ...query })}`)).blob();
  }

  /** Specification of a run of a region: TOML. */
  async zoom(region) {
    const answer = await this.ask("zoom", {
      method: "POST", body: JSON.stringify(region), headers: { "Content-Type": "application/json" },
    });
    return answer.text();
  }
}
