// Where the page begins: finds out where its data are, and shows them.

import { start } from "./app.js";
import { LiveClient, liveAddress } from "./live.js";
import { InlineSource } from "./source-inline.js";
import { ServerSource } from "./source.js";

const root = document.getElementById("app");
const { mode, token } = { ...root.dataset, ...window.MAGPEND };

/** The source of each kind of page. */
const SOURCES = {
  server: async () => {
    const source = new ServerSource(token);
    const view = await source.view().catch(() => null);
    if (view?.live) source.live = new LiveClient(liveAddress(token));
    return source;
  },
  inline: async () => new InlineSource(document),
};

SOURCES[mode]().then((source) => start(source, root));
