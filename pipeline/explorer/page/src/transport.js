// How requests and messages travel to what answers them: by HTTP and a websocket to a server on this machine. A
// transport has `ask`, which gives the content of an answer, and `connect`, which opens a channel for live messages;
// transport-widget.js has the one of a notebook.

import { SourceError } from "./source-error.js";

const STOPPED = "The server does not answer. Was magpend explore stopped? Start it again, then press Try again.";

export class ServerTransport {
  /** @param {string} token what lets this page in */
  constructor(token) {
    this.token = token;
  }

  /**
   * Ask for an answer of pipeline/explorer/answers.py.
   * @param {string} name
   * @param {Object<string, string>} words arguments by name
   * @param {string|null} [body]
   * @returns {Promise<{content: ArrayBuffer, kind: string}>} rejects with a SourceError
   */
  async ask(name, words, body = null) {
    const query = new URLSearchParams(words).toString();
    const sent = body === null ? {} : { method: "POST", body };
    const headers = { Authorization: `token ${this.token}`, ...(body === null ? {} : { "Content-Type": "application/json" }) };
    let answer, content;
    try {
      answer = await fetch(`api/${name}${query ? `?${query}` : ""}`, { cache: "no-store", credentials: "same-origin", redirect: "error", headers, ...sent });
      content = await answer.arrayBuffer();
    } catch {
      throw new SourceError(STOPPED, true);
    }
    if (answer.ok) return { content, kind: answer.headers.get("Content-Type") ?? "" };
    throw new SourceError(sentenceIn(content) ?? `The server answered with an error (${answer.status}).`);
  }

  /**
   * Open a channel for live messages.
   * @param {{opened: function(): void, taken: function(string|ArrayBuffer): void, closed: function(): void}} hears
   * @returns {{isOpen: boolean, send: function(string): void, close: function(): void}}
   */
  connect({ opened, taken, closed }) {
    const socket = new WebSocket(liveAddress(this.token));
    socket.binaryType = "arraybuffer";
    socket.onopen = opened;
    socket.onmessage = ({ data }) => taken(data);
    socket.onclose = closed;
    return {
      get isOpen() {
        return socket.readyState === WebSocket.OPEN;
      },
      send: (text) => socket.send(text),
      close: () => socket.close(),
    };
  }
}

function sentenceIn(content) {
  try {
    return JSON.parse(new TextDecoder().decode(content)).error ?? null;
  } catch {
    return null;
  }
}

/** Address of the connection beside a page, with the page's token. */
export function liveAddress(token, page = location) {
  const address = new URL("ws", page.href);
  address.protocol = page.protocol === "https:" ? "wss:" : "ws:";
  address.hash = "";
  address.search = `?token=${encodeURIComponent(token)}`;
  return address.href;
}
