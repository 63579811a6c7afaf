// What magpend computes while one watches: one connection, jobs by number, pieces as they come.

import { unpackArrays } from "./arrays.js";

const FIRST_WAIT_MS = 500, LONGEST_WAIT_MS = 15000;

/** A job that came to nothing, with the sentence that says why. */
export class LiveError extends Error {}

export class LiveClient {
  /**
   * @param {function(Object): Object} open opens a channel, as `connect` of a transport
   */
  constructor(open) {
    this.open = open;
    this.jobs = new Map();
    this.listeners = new Set();
    this.serial = 0;
    this.wait = FIRST_WAIT_MS;
    this.status = { connected: false, warming: null };
    this.closed = false;
    this.waiting = [];
    this.connect();
  }

  /** Call `listener` with {connected, warming: null | {done, total}} whenever that changes. */
  on(listener) {
    this.listeners.add(listener);
    listener(this.status);
    return () => this.listeners.delete(listener);
  }

  tell(patch) {
    this.status = { ...this.status, ...patch };
    for (const listener of this.listeners) listener(this.status);
  }

  connect() {
    if (this.closed) return;
    this.channel = this.open({
      opened: () => {
        this.wait = FIRST_WAIT_MS;
        this.tell({ connected: true });
        for (const text of this.waiting.splice(0)) this.channel.send(text);
      },
      taken: (data) => this.take(data),
      closed: () => this.lose(),
    });
  }

  lose() {
    this.tell({ connected: false, warming: null });
    this.waiting = [];
    const jobs = [...this.jobs.values()];
    this.jobs.clear();
    for (const job of jobs) job.reject(new LiveError("The connection to magpend was lost; it is being sought again."));
    if (this.closed) return;
    this.timer = setTimeout(() => this.connect(), this.wait);
    this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.channel.close();
  }

  take(data) {
    const piece = typeof data === "string" ? { attrs: JSON.parse(data), arrays: {}, shapes: {} } : unpackArrays(data);
    const { id, kind, what, done, total } = piece.attrs;
    if (what === "warming") return this.tell({ warming: done < total ? { done, total } : null });
    const job = this.jobs.get(id);
    if (!job) return undefined;
    if (kind === "error") {
      this.jobs.delete(id);
      return job.reject(new LiveError(piece.attrs.error));
    }
    if (kind !== "done") job.onPiece(kind, piece);
    // a followed orbit comes whole and is the end of its job
    if (kind !== "done" && kind !== "orbit") return undefined;
    this.jobs.delete(id);
    return job.resolve(piece.attrs);
  }

  /**
   * Ask for a job.
   * @param {"start"|"slice"|"follow"|"run"} what
   * @param {Object} request
   * @param {function(string, {attrs: Object, arrays: Object, shapes: Object}): void} [onPiece] takes what comes
   *   before the end: its kind, its arrays
   * @returns {{id: number, done: Promise<Object>, cancel: function(): void}} `done` gives the last message, with
   *   `cancelled` true if a newer job took its place or it was cancelled
   */
  job(what, request, onPiece = () => {}) {
    const id = ++this.serial;
    const done = new Promise((resolve, reject) => this.jobs.set(id, { resolve, reject, onPiece }));
    this.send({ id, do: what, ...request });
    return { id, done, cancel: () => this.cancel(id) };
  }

  cancel(id) {
    const job = this.jobs.get(id);
    if (!job) return;
    this.jobs.delete(id);
    this.send({ id: ++this.serial, do: "cancel", job: id });
    job.resolve({ id, cancelled: true });
  }

  send(message) {
    const text = JSON.stringify(message);
    if (this.channel.isOpen) this.channel.send(text);
    else this.waiting.push(text);
  }
}
