// Colours of the page as canvases need them: read from the style sheet, again whenever light becomes dark.

const FALLBACK = {
  ink: "#1b1b1b", muted: "#5c5c5c", line: "#8a8a8a", grid: "#e4e4e4", paper: "#ffffff", card: "#ffffff",
  accent: "#0072B2", warn: "#D55E00", good: "#009E73",
};

const listeners = new Set(), hosts = new Set();
let cached = null, chosen = null;

/** Colours by name: ink, muted, line, grid, paper, card, accent, warn, good. All pages of a window have the same. */
export function theme() {
  if (cached) return cached;
  const element = [...hosts].map(({ themed }) => themed).find((one) => one.isConnected) ?? document.documentElement;
  const style = getComputedStyle(element), found = {};
  for (const [name, value] of Object.entries(FALLBACK)) found[name] = style.getPropertyValue(`--${name}`).trim() || value;
  // what does not stand in the window yet has no style
  if (element.isConnected && hosts.size) cached = found;
  return found;
}

/** Dress a host in the colours; returns what ends that. */
export function dress(host) {
  hosts.add(host);
  applyTheme();
  return () => hosts.delete(host);
}

/** What the reader chose: true for dark, false for light, null for what the surroundings have. */
export function chosenDark() {
  return chosen;
}

export function chooseDark(dark) {
  chosen = dark;
  applyTheme();
}

/** Make all hosts dark or light: as the reader chose, else as their surroundings are. */
export function applyTheme() {
  for (const host of hosts) {
    const dark = chosen ?? host.dark(), wanted = dark === null ? undefined : dark ? "dark" : "light";
    if (host.themed.dataset.theme === wanted) continue;
    if (wanted) host.themed.dataset.theme = wanted;
    else delete host.themed.dataset.theme;
  }
  themeChanged();
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

if (typeof matchMedia === "function") matchMedia("(prefers-color-scheme: dark)").addEventListener("change", applyTheme);
