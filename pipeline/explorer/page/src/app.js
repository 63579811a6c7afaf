// The page: puts its parts beside each other and joins them by one state.

import { defaults, fromAddress, keepAddress } from "./address.js";
import { told } from "./axes.js";
import { Curves } from "./curves.js";
import { Diagram } from "./diagram.js";
import { Events } from "./events.js";
import { el } from "./dom.js";
import { scaled } from "./gestures.js";
import { Legend } from "./legend.js";
import { Messages } from "./messages.js";
import { mountPanels } from "./panels.js";
import { ParameterPlane } from "./parameter-plane.js";
import { download } from "./picture.js";
import { pictureOfView } from "./view-picture.js";
import { createState } from "./state.js";
import { SourceError } from "./source-error.js";
import { beginDark, themeSwitch } from "./switch.js";
import { tabs } from "./tabs.js";
import { applyTheme, dress } from "./theme.js";
import { Toolbar } from "./toolbar.js";

/** Format of the answers that this page understands; see pipeline/explorer/data/view.py. */
const FORMAT = 1;

/** Widths of the page [px] below which it is medium, slim and small; the style sheets name them. */
const ROOMS = [["medium", 960], ["slim", 760], ["small", 600]];

/**
 * Show a run.
 * @param {Object} source
 * @param {Object} host what the page stands in, see host.js
 * @returns {Promise<{end: function(): void}>} ends the page, with all that it asked for
 */
export async function start(source, host) {
  const { root } = host, messages = new Messages(), page = { ends: [] };
  // what was begun last ends first
  page.end = () => page.ends.splice(0).reverse().forEach((end) => end());
  root.classList.add("explorer");
  page.ends.push(dress(host), measureRoom(root), () => source.live?.close());
  if (host.watch) page.ends.push(host.watch(applyTheme));
  beginDark();
  const show = async () => {
    root.replaceChildren(messages.banner, el("p", { class: "loading", role: "status", text: "Reading the run …" }));
    try {
      const view = await source.view();
      if (view.format !== FORMAT) throw new Error(`The run is described in format ${view.format}, and this page knows ${FORMAT}: reload it.`);
      build(source, host, view, messages, page);
    } catch (error) {
      root.querySelector(".loading")?.remove();
      messages.problem(error, () => show());
      if (!(error instanceof SourceError)) throw error;
    }
  };
  await show();
  return page;
}

/** Say by an attribute how much room there is; returns what ends that. */
function measureRoom(root) {
  let isFirst = true;
  const measure = () => {
    const width = root.clientWidth;
    if (!width) return;
    root.dataset.room = ROOMS.filter(([, most]) => width <= most).map(([name]) => name).join(" ");
    // an output of a notebook has colours once it stands in the window
    if (isFirst) applyTheme();
    isFirst = false;
  };
  const observer = new ResizeObserver(measure);
  observer.observe(root);
  measure();
  return () => observer.disconnect();
}

function build(source, host, view, messages, page) {
  const { root } = host;
  const state = createState({ ...defaults(view), ...fromAddress(host.place.read(), view) });
  host.title(`${view.title || view.name} – magpend`);
  const legend = new Legend(state, view);
  const reader = {
    say: (text) => messages.say(text),
    problem: (error) => messages.problem(error, error ? () => diagram.load() : null),
    help: () => toolbar.showHelp(),
    told: ({ count, data, attrs }) => {
      legend.setPresent(data);
      messages.facts.textContent = factsOf(view, count, data, attrs);
      messages.say(messages.facts.textContent);
      // their horizontal axis is the diagram's, which is known only now
      curves.repaint();
    },
  };
  const diagram = new Diagram(state, source, view, reader, host.wheelAlways);
  const curves = new Curves(state, source, view, diagram, reader);
  const events = new Events(state, source, view, diagram, reader);
  const doing = doings({ state, source, view, diagram, curves, messages });
  const toolbar = new Toolbar(state, view, source.formats ?? ["csv"], doing);
  toolbar.curves = curves;
  curves.onLoaded = () => toolbar.showToggles();
  if (source.notice) messages.note(source.notice);
  else if (view.cells.pending) messages.note(pendingOf(view), () => host.reload());
  const plane = new ParameterPlane(state, source, view, diagram), dark = themeSwitch();
  const left = el("div", { class: "main-column" }, toolbar.element, legend.element, diagram.element, events.element, curves.element, plane.element, messages.facts);
  const right = el("div", { class: "side-column" });
  const layout = el("div", { class: "layout" }, left, right);
  root.replaceChildren(
    header(view, toolbar.helpButton, dark.element), messages.banner, messages.notes, messages.progress, tabs(state, root, left, right), layout, messages.line,
  );
  const panels = mountPanels(state, source, right, view);
  page.ends.push(keepAddress(state, view, host.place), dark.forget, ...[diagram, events, curves, toolbar, legend, plane, panels].map((part) => () => part.destroy()));
  host.shown(Object.assign(page, { state, source, diagram }));
  diagram.load();
}

function header(view, help, dark) {
  const name = view.title && view.title !== view.name ? el("span", { class: "run-name", text: view.name }) : null;
  return el("header", { class: "page-header" },
    el("div", { class: "titles" }, el("h1", { text: view.title || view.name }), name, el("span", { class: "run-name", text: view.model.title })),
    el("div", { class: "page-buttons" }, help, dark));
}

/** One line on what is shown. */
function factsOf(view, count, data, attrs) {
  const whole = (n) => n.toLocaleString("en");
  const parts = [`${whole(count)} points of ${whole(data.at.length)} cells`];
  if (attrs.kept < attrs.n_keep) parts.push(`the last ${whole(attrs.kept)} of ${whole(attrs.n_keep)} sections of each`);
  if (view.cells.failed) parts.push(`${whole(view.cells.failed)} cells of the run failed or diverged`);
  if (view.model.section) parts.push(view.model.section);
  return parts.join(" · ");
}

function pendingOf(view) {
  const { total, pending } = view.cells, share = told((100 * (total - pending)) / total);
  return `This run is not complete: ${pending.toLocaleString("en")} of ${total.toLocaleString("en")} cells are pending (${share} % done). magpend run goes on with it.`;
}

/** What the buttons do. */
function doings(page) {
  const { state, source, diagram, messages } = page;
  const guarded = (call) => async (...args) => {
    try {
      await call(...args);
    } catch (error) {
      messages.problem(error);
    }
  };
  return {
    canRun: Boolean(source.live),
    zoom: (factor) => {
      const [x0, x1, y0, y1] = diagram.window;
      diagram.moveTo(scaled(diagram.window, (x0 + x1) / 2, (y0 + y1) / 2, factor, factor));
    },
    reset: () => diagram.reset(),
    save: guarded((kind, format) => (kind === "picture" ? savePicture(page, format) : saveData(page, kind, format))),
    region: guarded((what) => (what === "run" ? runHere(page) : saveZoom(page))),
    state,
  };
}

function nameOf({ view, state }, kind) {
  const { x, y } = state.get();
  return [view.name, kind, ...(kind === "diagram" ? [y, x] : [])].join("-").replace(/[^\w.-]+/g, "_");
}

async function savePicture(page, format) {
  download(`${nameOf(page, "diagram")}.${format}`, await pictureOfView(page, format));
}

async function saveData(page, kind, format) {
  const { x, y, at } = page.state.get();
  const query = kind === "curves" ? { x, at } : { x, y, at };
  page.messages.show("The data are being written …");
  try {
    download(`${nameOf(page, kind)}.${format}`, await page.source.table(kind, query, format));
  } finally {
    page.messages.show(null);
  }
}

/** What the window shows, as a region for a run: no more than there is on the horizontal axis. */
function regionOf({ state, diagram }) {
  const { x, y, at } = state.get(), [x0, x1, y0, y1] = diagram.window, values = diagram.horizontal.values;
  const low = Math.min(values[0], values.at(-1)), high = Math.max(values[0], values.at(-1));
  return { x: [Math.max(low, x0), Math.min(high, x1)], y: [y0, y1], axes: [x, y], at };
}

async function saveZoom(page) {
  const text = await page.source.zoom(regionOf(page));
  download(`${nameOf(page, "zoom")}.toml`, new Blob([text], { type: "application/toml" }));
  page.messages.say("The specification is downloaded: magpend run computes it.");
}

async function runHere(page) {
  const { messages, source } = page;
  const job = source.live.job("run", regionOf(page), (kind, { attrs }) => {
    const { done, total, name } = attrs;
    messages.show(`${name ?? "The zoom"}: ${done ?? 0} of ${total ?? "?"} tasks`, total ? done / total : null, job.cancel);
  });
  messages.show("The zoom is being prepared …", null, job.cancel);
  try {
    const { name, cancelled } = await job.done;
    messages.show(cancelled ? "Stopped. What is computed is kept; the same zoom goes on from there."
      : `Computed: ${name}, beside this run. Look at it with magpend explore ${name}.`);
  } catch (error) {
    messages.show(null);
    throw error;
  }
}
