// What the page stands in: a window of its own here; host-widget.js has an output of a notebook. A host has
// `root`, the element that the page fills; `themed`, the element that has the colours; `place`, which keeps the view;
// `wheelAlways`, whether the wheel zooms unasked; and methods that only one kind of them needs.

export class WindowHost {
  /** @param {HTMLElement} root */
  constructor(root) {
    this.root = root;
    this.themed = document.documentElement;
    this.place = addressPlace;
    this.wheelAlways = true;
  }

  /** Name the window. */
  title(text) {
    document.title = text;
  }

  /** Take the page once it is shown, for the console. */
  shown(page) {
    window.magpend = page;
  }

  /** Read the run again. */
  reload() {
    location.reload();
  }

  /** Colours that the surroundings ask for: the style sheet knows. */
  dark() {
    return null;
  }
}

/** The view in the window's address: every change that settles is an entry of the history. */
const addressPlace = {
  read: () => location.hash.slice(1),
  write(text, isNew) {
    const address = `${location.pathname}${location.search}#${text}`;
    if (isNew) history.pushState(null, "", address);
    else history.replaceState(null, "", address);
  },
  on(listener) {
    addEventListener("popstate", listener);
    addEventListener("hashchange", listener);
    return () => {
      removeEventListener("popstate", listener);
      removeEventListener("hashchange", listener);
    };
  },
};
