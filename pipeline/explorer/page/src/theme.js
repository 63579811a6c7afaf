// Colours of the page as canvases need them: read from the style sheet, again whenever light becomes dark.

const FALLBACK = {
  ink: "#1b1b1b", muted: "#5c5c5c", line: "#8a8a8a", grid: "#e4e4e4", paper: "#ffffff", card: "#ffffff",
  accent: "#0072B2", warn: "#D55E00", good: "#009E73",
};

const listeners = new Set();
let cached = null;

/** Colours by name: ink, muted, line, grid, paper, card, accent, warn, good. */
export function theme() {
  if (!cached) {
    const style = getComputedStyle(document.documentElement);
    cached = {};
    for (const [name, value] of Object.entries(FALLBACK)) {
      cached[name] = style.getPropertyValue(`--${name}`).trim() || value;
    }
  }
  return cached;
}

/** Call `listener` whenever the colours change; returns what ends that. */
export function onTheme(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** Say that the colours have changed. */
export function themeChanged() {
  cached = null;
  for (const listener of listeners) listener();
}

/** Whether the reader asked for less motion. */
export function wantsLessMotion() {
  return matchMedia("(prefers-reduced-motion: reduce)").matches;
}

if (typeof matchMedia === "function") {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themeChanged);
  new MutationObserver(themeChanged).observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
}
