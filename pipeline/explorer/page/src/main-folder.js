// Where the page of an exported folder begins: it alone has zarrita in it.

import { start } from "./app.js";
import { WindowHost } from "./host.js";
import { FolderSource } from "./source-folder.js";

const root = document.getElementById("app");

start(new FolderSource(root.dataset.objects), new WindowHost(root));
