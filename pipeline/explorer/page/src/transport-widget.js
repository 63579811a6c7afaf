// How requests and messages travel in a notebook: as custom messages of the widget's model, answered by the kernel
// (pipeline/explorer/connection.py lists them). Several outputs share a model, so messages name their page.

import { SourceError } from "./source-error.js";

const GONE = "The kernel does not answer any more. Run the cell again.";

/** Events of a model whose kernel was restarted or whose widget was closed, where the notebook tells. */
const ENDS = ["comm_live_update", "comm:close", "destroy"];

export class WidgetTransport {
  /** @param {Object} model of anywidget */
  constructor(model) {
    this.model = model;
    this.page = pageName();
    this.serial = 0;
    this.waiting = new Map();
    this.channel = null;
    this.isGone = false;
    this.take = this.take.bind(this);
    this.lose = this.lose.bind(this);
    model.on("msg:custom", this.take);
    for (const event of ENDS) model.on(event, this.lose);
  }

  /** As `ServerTransport.ask`. */
  ask(name, words, body = null) {
    if (this.isGone) return Promise.reject(new SourceError(GONE, true));
    const id = ++this.serial;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.send({ id, ask: name, words, body });
    });
  }

  /** As `ServerTransport.connect`. */
  connect({ opened, taken, closed }) {
    const channel = { isOpen: !this.isGone, taken, closed, send: (text) => this.send({ live: text }) };
    channel.close = () => {
      if (channel.isOpen) this.send({ close: true });
      channel.isOpen = false;
    };
    if (this.isGone) return channel;
    this.channel = channel;
    this.send({ open: true });
    // after the caller has the channel
    queueMicrotask(opened);
    return channel;
  }

  send(message) {
    try {
      this.model.send({ page: this.page, ...message });
    } catch {
      this.lose();
    }
  }

  take(message, buffers) {
    if (message?.page !== this.page) return;
    const content = buffers?.length ? copied(buffers[0]) : null;
    if (message.live !== undefined) {
      this.channel?.taken(message.live === true ? content : message.live);
      return;
    }
    const { resolve, reject } = this.waiting.get(message.id) ?? {};
    this.waiting.delete(message.id);
    if (message.status === 200) resolve?.({ content, kind: message.kind });
    else reject?.(new SourceError(message.error));
  }

  /** Nothing is answered any more. */
  lose() {
    this.isGone = true;
    for (const { reject } of this.waiting.values()) reject(new SourceError(GONE, true));
    this.waiting.clear();
    if (this.channel) {
      this.channel.isOpen = false;
      this.channel.closed();
    }
    this.channel = null;
  }

  /** Say that the page has gone, and hear nothing more. */
  end() {
    if (!this.isGone) this.send({ close: true });
    this.model.off("msg:custom", this.take);
    for (const event of ENDS) this.model.off(event, this.lose);
    this.waiting.clear();
    this.channel = null;
  }
}

/** A name that no other page of a notebook has. */
function pageName() {
  return Array.from(crypto.getRandomValues(new Uint32Array(3)), (part) => part.toString(36)).join("-");
}

/** The bytes of a buffer as one of its own: arrays in it must begin at multiples of eight. */
function copied(buffer) {
  const view = ArrayBuffer.isView(buffer) ? buffer : new Uint8Array(buffer);
  return view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength);
}
