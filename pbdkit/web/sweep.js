/** A map over the parameters of a sweep: a cell a member, coloured by a number of it. */

import { short } from "./chart.js";
import { gradient, mapped, UNKNOWN } from "./colours.js";
import { choice, labelled, make } from "./dom.js";

const STATUS = "status";
const GOOD = ["complete", "settled"], COLOURS = { good: "#4E9A8B", bad: "#C0504D" };
const MOST = 10000; // so many cells a browser shows at once without delay

export class SweepMap {
  /** `open(n, name)` is called with the member, the last dimension of the grid going fastest. */
  constructor(place, { grid, status, message, scalars, open }) {
    Object.assign(this, { grid, status, message, scalars, open });
    this.at = grid.map(() => 0);
    this.across = Math.max(0, grid.findIndex(({ labels }) => labels.length > 1));
    this.up = grid.findIndex(({ labels }, n) => n !== this.across && labels.length > 1);
    this.shown = scalars.length ? scalars[0] : null;
    const names = [...scalars.map(({ name }) => [name, name]), [STATUS, STATUS]];
    const what = choice(names, (name) => {
      this.shown = scalars.find((scalar) => scalar.name === name) ?? null;
      this.#draw();
    });
    this.others = make("div", { className: "choices" });
    this.map = make("div", { className: "map" });
    this.scale = make("div", { className: "scale" });
    this.read = make("p", { className: "readout", "aria-live": "polite" }, "\u00a0");
    const axes = grid.map(({ name }, n) => [n, name]);
    const alongX = choice(axes, (n) => this.#turn(Number(n), this.up));
    const alongY = choice([[-1, "none"], ...axes], (n) => this.#turn(this.across, Number(n)));
    Object.assign(this, { alongX, alongY });
    const turned = grid.length > 1 ? [labelled("Across", alongX), labelled("Up", alongY)] : [];
    place.append(make("div", { className: "choices" }, labelled("Colour", what), ...turned),
      this.others, this.map, this.scale, this.read);
    this.#turn(this.across, this.up);
  }

  #turn(across, up) {
    this.across = across;
    this.up = up === across ? this.grid.findIndex((_, n) => n !== across) : up;
    this.alongX.value = this.across;
    this.alongY.value = this.up;
    const rest = this.grid.map((_, n) => n).filter((n) => n !== this.across && n !== this.up);
    this.others.replaceChildren(...rest.map((n) => {
      const places = this.grid[n].labels.map((label, k) => [k, label]);
      const chosen = choice(places, (k) => { this.at[n] = Number(k); this.#draw(); });
      chosen.value = this.at[n];
      return labelled(this.grid[n].name, chosen);
    }));
    this.#draw();
  }

  #member(x, y) {
    const at = this.at.map((own, n) => (n === this.across ? x : n === this.up ? y : own));
    return at.reduce((sum, place, n) => sum * this.grid[n].labels.length + place, 0);
  }

  #name(x, y) {
    const place = (n) => (n === this.across ? x : n === this.up ? y : this.at[n]);
    return this.grid.map(({ name, labels }, n) => `${name} = ${labels[place(n)]}`).join(", ");
  }

  #draw() {
    const named = ({ labels, name, unit }) => [labels, unit ? `${name} (${unit})` : name];
    const [columns, xName] = named(this.grid[this.across]);
    const [rows, yName] = this.up < 0 ? [[""], ""] : named(this.grid[this.up]);
    const [width, height] = [columns.length, Math.min(rows.length, Math.ceil(MOST / columns.length))];
    const values = this.shown?.values;
    const range = values ? extremes(values) : [0, 1];
    const bytes = mapped(false, 256);
    this.map.style.setProperty("--columns", width);
    const cells = [make("span", { className: "y name" }, yName), make("span", { className: "rest" })];
    for (let y = height - 1; y >= 0; y--) {
      cells.push(make("span", { className: "y", title: rows[y] }, rows[y]));
      for (let x = 0; x < width; x++) cells.push(this.#cell(x, y, values, range, bytes));
    }
    cells.push(make("span", {}));
    const every = Math.ceil(width / 12);
    columns.forEach((label, x) => cells.push(make("span", { className: "x", title: label },
      x % every ? "" : label)));
    cells.push(make("span", {}), make("span", { className: "x name rest" }, xName));
    this.map.replaceChildren(...cells);
    this.#explain(range);
  }

  #cell(x, y, values, [low, high], bytes) {
    const member = this.#member(x, y), name = this.#name(x, y), status = this.status[member];
    const told = values ? `${short(values[member])}, ${status}` : status;
    const words = `${name}: ${told}`;
    const show = () => { this.read.textContent = words; };
    const cell = make("button", {
      type: "button", className: "cell", "aria-label": words, onpointerenter: show, onfocus: show,
      onclick: () => {
        this.map.querySelector("[aria-pressed]")?.removeAttribute("aria-pressed");
        cell.setAttribute("aria-pressed", "true");
        this.open(member, name);
      },
    });
    cell.style.background = values ? UNKNOWN : GOOD.includes(status) ? COLOURS.good : COLOURS.bad;
    if (values && Number.isFinite(values[member])) {
      const at = 4 * Math.round(255 * (high > low ? (values[member] - low) / (high - low) : 0.5));
      cell.style.background = `rgb(${bytes.slice(at, at + 3).join(" ")})`;
    }
    return cell;
  }

  #explain([low, high]) {
    if (!this.shown) {
      const names = [["good", "complete or settled"], ["bad", "failed"]];
      this.scale.replaceChildren(...names.map(([which, name]) => {
        const item = make("span", { className: "kind" }, name);
        item.style.setProperty("--colour", COLOURS[which]);
        return item;
      }));
      return;
    }
    const bar = make("span", { className: "bar" });
    bar.style.background = gradient(false);
    this.scale.replaceChildren(make("span", {}, short(low)), bar, make("span", {}, short(high)),
      make("span", { className: "means" }, this.shown.name));
  }
}

function extremes(values) {
  const known = [...values].filter(Number.isFinite);
  return known.length ? [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))] : [0, 1];
}
