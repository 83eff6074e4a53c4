/** Elements of the page; all text in them is text. */

/** make("p", {className: "note", "aria-live": "polite", onclick: act}, "words", element, ...). */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in element) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

/** A label around its control. */
export function labelled(words, control, ...more) {
  return make("label", {}, make("span", {}, words), control, ...more);
}

/** A <select> of [value, words]; `act` is called with the value chosen. */
export function choice(options, act) {
  const found = make("select", { onchange: () => act(found.value) });
  found.append(...options.map(([value, words]) => make("option", { value }, words)));
  return found;
}

/** A table of rows of texts; headings are texts, or texts with what they mean. */
export function table(headings, rows) {
  const head = headings.map((heading) => {
    const [words, meaning] = [heading].flat();
    return make("th", { scope: "col", title: meaning ?? "" }, words);
  });
  const body = rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", {}, String(cell)))));
  const whole = make("table", {}, make("tbody", {}, ...body));
  if (headings.length) whole.prepend(make("thead", {}, make("tr", {}, ...head)));
  return make("div", { className: "wide", tabIndex: 0, role: "region", "aria-label": "table" }, whole);
}

/** A section of the page with its heading. */
export function section(title, ...children) {
  return make("section", {}, make("h2", {}, title), ...children);
}
