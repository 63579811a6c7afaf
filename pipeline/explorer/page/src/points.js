// The points of a diagram, held by a worker so that the page goes on while they are drawn.

import { answer } from "./drawing-answers.js";
import source from "worker:./drawing-worker.js";

export class Points {
  constructor() {
    this.waiting = new Map();
    this.serial = 0;
    try {
      const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      this.worker = new Worker(address);
      URL.revokeObjectURL(address);
      this.worker.onmessage = ({ data }) => this.take(data);
      this.worker.onerror = () => this.fallBack();
    } catch {
      this.worker = null;
    }
    this.held = {};
  }

  // a page that may have no worker draws by itself: slower, the same
  fallBack() {
    this.worker = null;
    for (const { reject } of this.waiting.values()) reject(new Error("This page may have no worker: reload it."));
    this.waiting.clear();
  }

  /** Stop the worker; what was asked is not answered. */
  end() {
    this.worker?.terminate();
    this.waiting.clear();
  }

  take({ id, result, error }) {
    const { resolve, reject } = this.waiting.get(id) ?? {};
    this.waiting.delete(id);
    if (error) reject?.(new Error(error));
    else resolve?.(result);
  }

  /** Ask for something in `drawing-answers.js`; a picture that a newer question overtakes is null. */
  async ask(what, args, transfer = []) {
    if (!this.worker) return (await answer(this.held, what, args)).result;
    const id = ++this.serial;
    const answered = new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
    this.worker.postMessage({ id, what, args }, transfer);
    return answered;
  }
}
