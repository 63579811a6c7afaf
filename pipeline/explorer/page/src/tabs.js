// On a narrow page: the diagram or the orbit, one at a time.

import { el } from "./dom.js";

const TABS = [["diagram", "Diagram"], ["orbit", "Orbit"]];

/** The two tabs; the page's style sheet shows them where both columns have no room. */
export function tabs(state, root, left, right) {
  const columns = { diagram: left, orbit: right };
  const buttons = TABS.map(([name, text]) => {
    columns[name].id = `column-${name}`;
    return el("button", {
      type: "button", role: "tab", id: `tab-${name}`, "aria-controls": `column-${name}`, "data-tab": name, text,
      on: { click: () => state.set({ panel: name }), keydown: (event) => move(event) },
    });
  });
  const move = (event) => {
    if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    const next = buttons[(buttons.indexOf(event.target) + 1) % buttons.length];
    state.set({ panel: next.dataset.tab });
    next.focus();
  };
  const show = () => {
    const shown = state.get().panel === "orbit" ? "orbit" : "diagram";
    root.dataset.tab = shown;
    for (const button of buttons) {
      button.setAttribute("aria-selected", String(button.dataset.tab === shown));
      button.tabIndex = button.dataset.tab === shown ? 0 : -1;
    }
    buttons[1].classList.toggle("has-news", shown === "diagram" && state.get().selected !== null);
  };
  state.on(["panel", "selected"], show);
  show();
  return el("div", { class: "tabs", role: "tablist", "aria-label": "What is shown" }, ...buttons);
}
