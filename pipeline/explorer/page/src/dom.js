// Elements with text: what a run's titles and names say is set as text, never as markup.

/**
 * Make an element.
 * @param {string} tag
 * @param {Object} [attributes] `text` is its text, `on` its listeners by event, the rest attributes;
 *   true stands for an attribute without a value, false and null leave it out
 * @param {...(Node|string|null)} children
 */
export function el(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") element.textContent = value;
    else if (name === "on") for (const [event, listener] of Object.entries(value)) element.addEventListener(event, listener);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** A card with a heading; `body` takes what it shows. */
export function card(title, name) {
  const body = el("div", { class: "panel-body" });
  const heading = el("h2", { text: title });
  const element = el("section", { class: `card panel panel-${name}`, "aria-label": title }, heading, body);
  return { element, heading, body };
}

/** Show or hide an element, for readers of a screen as well. */
export function show(element, visible) {
  element.hidden = !visible;
}

/** The element inside of another one that has the focus, or null; also in a shadow root. */
export function focusedIn(element) {
  const found = element.getRootNode().activeElement ?? null;
  return found && element.contains(found) ? found : null;
}

let serial = 0;

/** An id that no other element of the page has, for labels. */
export function freshId(stem) {
  serial += 1;
  return `panel-${stem}-${serial}`;
}

/** A select with a label before it; `options` are [value, text] pairs. */
export function labelledSelect(text, options, value, onchange) {
  const id = freshId("select");
  const select = el("select", { id, on: { change: () => onchange(select.value) } });
  for (const [key, title] of options) select.append(el("option", { value: key, text: title }));
  select.value = value;
  return { element: el("span", { class: "field" }, el("label", { for: id, text }), select), select };
}

/** A number as a field shows it: six significant digits. */
export function shortened(value) {
  return Number(value.toPrecision(6));
}

/** A number with its label; `change` takes what is a number. */
export function numberField(text, value, change) {
  const id = freshId("number");
  const input = el("input", { id, type: "number", step: "any", value: shortened(value), on: {
    change: () => Number.isFinite(input.valueAsNumber) && change(input.valueAsNumber),
  } });
  return el("span", { class: "field" }, el("label", { for: id, text }), input);
}
