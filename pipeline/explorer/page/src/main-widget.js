// Where the widget of a notebook begins: each output that shows it is a page of its own.

import { start } from "./app.js";
import { WidgetHost } from "./host-widget.js";
import { RunSource } from "./source.js";
import { WidgetTransport } from "./transport-widget.js";
import styles from "styles:";

async function render({ model, el }) {
  const host = new WidgetHost(model, el, styles), transport = new WidgetTransport(model);
  let page = null, isOver = false;
  const show = async () => {
    page?.end();
    page = null;
    const source = await new RunSource(transport).begin();
    page = isOver ? null : await start(source, host);
    if (isOver) page?.end();
  };
  host.again = show;
  // not awaited: the notebook goes on meanwhile
  show().catch((error) => console.error(error));
  return () => {
    isOver = true;
    page?.end();
    transport.end();
    host.end();
  };
}

export default { render };
