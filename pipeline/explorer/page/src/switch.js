// Light or dark: as the system says, unless the reader says otherwise. The choice stays in this browser and is
// no part of the address: a link shows a colleague the same view in the colleague's own colours.

import { el } from "./dom.js";

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

function apply(dark) {
  if (dark === null) delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = dark ? "dark" : "light";
}

/** Begin with what was chosen last. */
export function onDark(state) {
  const dark = remembered();
  apply(dark);
  state.set({ dark });
}

/** The button that goes from automatic to dark to light. */
export function themeSwitch(state) {
  const button = el("button", { type: "button", class: "theme-switch", on: { click: () => {
    const dark = NEXT.get(state.get().dark);
    remember(dark);
    apply(dark);
    state.set({ dark });
    show();
  } } });
  const show = () => {
    button.textContent = NAMES.get(state.get().dark);
    button.setAttribute("aria-label", `Colours: ${button.textContent}`);
    button.title = "Light, dark, or as the system says";
  };
  show();
  return button;
}
