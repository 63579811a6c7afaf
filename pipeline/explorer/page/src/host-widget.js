// An output of a notebook as what the page stands in: a shadow root, so that styles and ids of the page and of the
// notebook do not meet; the view in the widget's model; colours by what the output lies on.

import { el } from "./dom.js";
import { luminance, parsed } from "./palette.js";

/** Luminance below which a ground is dark. */
const DARK = 0.2;

export class WidgetHost {
  /**
   * @param {Object} model of anywidget
   * @param {HTMLElement} element that the notebook gives
   * @param {string} styles text of the style sheet
   */
  constructor(model, element, styles) {
    this.model = model;
    // JupyterLab leaves keys to elements with this attribute
    this.themed = el("div", { class: "magpend-explorer", "data-lm-suppress-shortcuts": "true" });
    const shadow = this.themed.attachShadow({ mode: "open" });
    this.root = el("div");
    shadow.append(el("style", { text: styles }), this.root);
    element.append(this.themed);
    this.place = modelPlace(model);
    this.wheelAlways = false;
    this.resize = () => (this.root.style.height = `${model.get("height")}px`);
    this.resize();
    model.on("change:height", this.resize);
    this.themed.addEventListener("keydown", keepKey);
  }

  title() {}

  /** Take the page once it is shown, for the console. */
  shown(page) {
    this.themed.magpend = page;
  }

  /** Read the run again. */
  reload() {
    this.again?.();
  }

  /** Whether what the output lies on is dark. */
  dark() {
    return (this.wasDark = this.liesOnDark());
  }

  liesOnDark() {
    for (let at = this.themed.parentNode; at; at = at.parentNode ?? at.host) {
      if (!(at instanceof Element)) continue;
      const colour = getComputedStyle(at).backgroundColor;
      if (colour && !/^transparent$|, 0\)$|\/ 0\)$/.test(colour)) return luminance(parsed(colour)) < DARK;
    }
    return matchMedia("(prefers-color-scheme: dark)").matches;
  }

  /** Call `listener` when the notebook may have become dark or light. */
  watch(listener) {
    const observer = new MutationObserver(() => this.liesOnDark() !== this.wasDark && listener());
    for (const element of [document.documentElement, document.body]) observer.observe(element, { attributes: true });
    return () => observer.disconnect();
  }

  end() {
    this.model.off("change:height", this.resize);
    this.themed.remove();
  }
}

/** Keys of the page do nothing to the notebook; those that run a cell do. */
function keepKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || (event.shiftKey && event.key === "Enter")) return;
  event.stopPropagation();
}

/** The view in the widget's model, which all outputs of the widget and Python share. */
function modelPlace(model) {
  return {
    read: () => model.get("view"),
    write(text) {
      model.set("view", text);
      model.save_changes();
    },
    on(listener) {
      model.on("change:view", listener);
      return () => model.off("change:view", listener);
    },
  };
}
