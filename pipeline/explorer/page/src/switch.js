// Light or dark: as the system says, unless the reader says otherwise. The choice stays in this browser and is
// no part of the address: a link shows a colleague the same view in the colleague's own colours.

import { el } from "./dom.js";
import { chooseDark, chosenDark, onTheme } from "./theme.js";

const KEY = "magpend-dark";
const NEXT = new Map([[null, true], [true, false], [false, null]]);
const NAMES = new Map([[null, "Auto"], [true, "Dark"], [false, "Light"]]);

function remembered() {
  try {
    return { true: true, false: false }[localStorage.getItem(KEY)] ?? null;
  } catch {
    return null;
  }
}

function remember(dark) {
  try {
    if (dark === null) localStorage.removeItem(KEY);
    else localStorage.setItem(KEY, String(dark));
  } catch {
    // a page without storage forgets it
  }
}

/** Begin with what was chosen last. */
export function beginDark() {
  chooseDark(remembered());
}

/** The button that goes from automatic to dark to light. */
export function themeSwitch() {
  const button = el("button", { type: "button", class: "theme-switch", title: "Light, dark, or as the surroundings are", on: { click: () => {
    const dark = NEXT.get(chosenDark());
    remember(dark);
    chooseDark(dark);
  } } });
  const show = () => {
    button.textContent = NAMES.get(chosenDark());
    button.setAttribute("aria-label", `Colours: ${button.textContent}`);
  };
  show();
  return { element: button, forget: onTheme(show) };
}
