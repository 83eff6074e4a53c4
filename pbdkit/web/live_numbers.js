/** A number that can be turned: a slider, and a field that takes any value. */

import { labelled, make } from "./dom.js";

const APART_MS = 100; // between two values that are handed on

/** `span` and sent values are in lattice units; times `factor` they are in `units`, which are shown. */
export function numberRow({ name, span, units, factor }, send) {
  const [low, high] = span.map((value) => value * factor);
  const title = units ? `${name} (${units})` : name;
  let last = 0, waiting = null, current = null, touched = 0;
  const turn = (value) => {
    if (!Number.isFinite(value)) return show(current);
    clearTimeout(waiting);
    touched = performance.now();
    field.value = shortened(value);
    const wait = Math.max(0, last + APART_MS - touched);
    waiting = setTimeout(() => {
      last = performance.now();
      send({ do: "turn", name, value: value / factor });
    }, wait);
  };
  const range = slider(title, low, high, "any", (value) => turn(Number(value.toPrecision(4))));
  const field = make("input", {
    type: "text", inputMode: "decimal", spellcheck: false, "aria-label": `${title}, as a number`,
    onchange: () => turn(Number(field.value.replace(",", "."))),
  });
  const show = (value) => {
    if (value === undefined || value === null) return;
    current = value;
    if (performance.now() - touched < 3 * APART_MS) return; // the user is changing it
    range.value = value * factor;
    if (document.activeElement !== field) field.value = shortened(value * factor);
  };
  const element = make("div", { className: "number" }, labelled(title, field), range);
  return { name, show, element };
}

function shortened(value) {
  return String(Number(value.toPrecision(5)));
}

/** Slider that passes its value to `act`; `meaning` is its label for screen readers. */
export function slider(meaning, min, max, step, act) {
  const made = make("input", { type: "range", min, max, step, "aria-label": meaning });
  made.addEventListener("input", () => act(made.valueAsNumber));
  return made;
}
