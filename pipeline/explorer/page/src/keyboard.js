// What keys do while the diagram has the focus.

import { scaled } from "./gestures.js";

/** Keys and what they do, for the list that ? shows. */
export const KEYS = [
  ["+  −", "zoom in, zoom out"],
  ["← → ↑ ↓", "move the window; with a point selected: to the next point"],
  ["Shift + arrows", "move the window"],
  ["Enter", "select the point nearest the middle"],
  ["0  or  double click", "show all"],
  ["Esc", "let go of the selected point; then show all"],
  ["Shift + drag", "zoom into a box"],
  ["Wheel over an axis", "zoom along that axis only"],
  ["?", "this list"],
];

const ARROWS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down" };
const WAYS = { left: [-1, 0], right: [1, 0], up: [0, 1], down: [0, -1] };

/** Do what a key says; a key with no meaning here is left to the browser. */
export function onKey(event, diagram) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const [x0, x1, y0, y1] = diagram.window, middle = [(x0 + x1) / 2, (y0 + y1) / 2];
  const direction = ARROWS[event.key];
  if (direction && diagram.selection && !event.shiftKey) diagram.walk(direction);
  else if (direction) {
    const [dx, dy] = [WAYS[direction][0] * 0.1 * (x1 - x0), WAYS[direction][1] * 0.1 * (y1 - y0)];
    diagram.moveTo([x0 + dx, x1 + dx, y0 + dy, y1 + dy]);
  } else if (event.key === "+" || event.key === "=") diagram.moveTo(scaled(diagram.window, ...middle, 0.8, 0.8));
  else if (event.key === "-" || event.key === "_") diagram.moveTo(scaled(diagram.window, ...middle, 1.25, 1.25));
  else if (event.key === "?") diagram.reader.help();
  else if (event.key === "0" || event.key === "Home") diagram.reset();
  else if (event.key === "Enter" || event.key === " ") diagram.walk("right");
  else if (event.key === "Escape") {
    if (diagram.state.get().selected) diagram.state.set({ selected: null });
    else diagram.reset();
  } else return;
  event.preventDefault();
}
