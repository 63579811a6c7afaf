// Where the page begins: finds out where its data are, and shows them.

import { start } from "./app.js";
import { WindowHost } from "./host.js";
import { InlineSource } from "./source-inline.js";
import { RunSource } from "./source.js";
import { ServerTransport } from "./transport.js";

const root = document.getElementById("app");
const { mode, token } = { ...root.dataset, ...window.MAGPEND };

/** The source of each kind of page. */
const SOURCES = {
  server: () => new RunSource(new ServerTransport(token)).begin(),
  inline: async () => new InlineSource(document),
};

SOURCES[mode]().then((source) => start(source, new WindowHost(root)));
