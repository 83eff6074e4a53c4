/** A small line chart in SVG: axes, series with a legend, a readout, a marker of the step. */

const SPACE = "http://www.w3.org/2000/svg";
const NARROWEST = 300, WIDEST = 560, HEIGHT = 236;
const LEFT = 58, RIGHT = 14, TOP = 12, BOTTOM = 26;
export const SERIES = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#8A7600"];

/** A curve of so many points, or fewer, is a table of numbers. */
export const FEW = 2;

/** A number in few characters: 0.125, 1200, 3.2e-7. */
export function short(value, digits = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "none";
  if (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e6)) {
    return value.toExponential(digits - 1).replace(/\.?0+e/, "e").replace("e+", "e");
  }
  return String(Number(value.toPrecision(digits)));
}

/** Round numbers between two others, about `count` of them and `least` apart. */
export function ticks(low, high, count, least = 0) {
  const rough = Math.max((high - low) / count, least), power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * power).find((size) => size >= rough * 0.99);
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) {
    found.push(Number((n * step).toPrecision(12)));
  }
  return found;
}

function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (low > high) return [0, 1];
  const room = high > low ? 0.04 * (high - low) : 0.5 * Math.abs(high) || 0.5;
  return [low - room, high + room];
}

function element(name, attributes, text = "") {
  const made = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

export class Chart {
  /**
   * Draws into `place`: `x` and `series` [{name, values}] are of one length, with NaN for gaps.
   * `pick(n)` is called with the place along `x` that is clicked.
   */
  constructor(place, { title, x, series, xLabel = "step", yLabel = "", pick = null }) {
    this.width = Math.min(Math.max(place.clientWidth || WIDEST, NARROWEST), WIDEST);
    Object.assign(this, { x, series, pick, xLabel });
    this.across = this.#axis(extent(x), LEFT, this.width - RIGHT);
    this.up = this.#axis(extent(series.flatMap((s) => [...s.values])), HEIGHT - BOTTOM, TOP);
    this.svg = element("svg", {
      viewBox: `0 0 ${this.width} ${HEIGHT}`, class: "chart", role: "img", "aria-label": title,
    });
    this.#grid(xLabel);
    series.forEach((one, n) => this.#line(one.values, SERIES[n % SERIES.length]));
    this.mark = element("line", { class: "now", y1: TOP, y2: HEIGHT - BOTTOM, visibility: "hidden" });
    this.dots = series.map((_, n) => element("circle", {
      r: 4, fill: SERIES[n % SERIES.length], visibility: "hidden",
    }));
    this.svg.append(this.mark, ...this.dots);
    const figure = document.createElement("figure");
    const below = Object.assign(document.createElement("p"), { className: "x-label", textContent: xLabel });
    this.read = Object.assign(document.createElement("p"), { className: "readout" });
    figure.append(this.#legend(title, yLabel), this.svg, below, this.read);
    place.append(figure);
    this.svg.addEventListener("pointermove", (event) => this.#show(this.#nearest(event)));
    this.svg.addEventListener("pointerleave", () => this.#show(this.now ?? -1));
    if (pick) {
      this.svg.classList.add("picks");
      this.svg.addEventListener("click", (event) => pick(this.#nearest(event)));
    }
    this.setNow(-1);
  }

  /** Marks a place along `x`, none if it is -1. */
  setNow(n) {
    this.now = n;
    this.#show(n);
    const known = n >= 0 && Number.isFinite(this.x[n]);
    if (known) for (const end of ["x1", "x2"]) this.mark.setAttribute(end, this.across.at(this.x[n]));
    this.mark.setAttribute("visibility", known ? "visible" : "hidden");
  }

  #axis([low, high], from, to) {
    return { low, high, at: (value) => from + ((value - low) / (high - low)) * (to - from) };
  }

  #grid(xLabel) {
    const { across, up, svg } = this, bottom = HEIGHT - BOTTOM, right = this.width - RIGHT;
    for (const value of ticks(up.low, up.high, 5)) {
      const y = up.at(value);
      svg.append(element("line", { class: "grid", x1: LEFT, x2: right, y1: y, y2: y }));
      svg.append(element("text", { x: LEFT - 6, y: y + 4, "text-anchor": "end" }, short(value)));
    }
    const least = xLabel === "step" ? 1 : 0;
    for (const value of ticks(across.low, across.high, 6, least)) {
      const x = across.at(value);
      svg.append(element("line", { class: "axis", x1: x, x2: x, y1: bottom, y2: bottom + 4 }));
      svg.append(element("text", { x, y: bottom + 17, "text-anchor": "middle" }, short(value)));
    }
    const end = { x1: LEFT, x2: right, y1: bottom, y2: bottom, class: "axis" };
    svg.append(element("line", end));
  }

  #line(values, colour) {
    let path = "", before = false;
    for (let n = 0; n < this.x.length; n++) {
      const known = Number.isFinite(values[n]) && Number.isFinite(this.x[n]);
      const place = known && `${this.across.at(this.x[n]).toFixed(1)} ${this.up.at(values[n]).toFixed(1)}`;
      if (known) path += `${before ? "L" : "M"}${place}`;
      before = known;
    }
    this.svg.append(element("path", { d: path, class: "series", stroke: colour }));
  }

  #legend(title, units) {
    const caption = document.createElement("figcaption");
    caption.append(Object.assign(document.createElement("strong"), { textContent: title }));
    if (units) caption.append(`(${units})`);
    this.series.forEach(({ name }, n) => {
      if (!name) return;
      const item = Object.assign(document.createElement("span"), { textContent: name });
      item.style.setProperty("--colour", SERIES[n % SERIES.length]);
      caption.append(item);
    });
    return caption;
  }

  #nearest(event) {
    const box = this.svg.getBoundingClientRect();
    const at = ((event.clientX - box.left) / box.width) * this.width;
    const away = (n) => Math.abs(this.across.at(this.x[n]) - at);
    let best = 0;
    for (let n = 1; n < this.x.length; n++) if (!(away(n) >= away(best))) best = n;
    return best;
  }

  #show(n) {
    this.series.forEach(({ values }, k) => {
      const known = n >= 0 && Number.isFinite(values[n]) && Number.isFinite(this.x[n]);
      this.dots[k].setAttribute("visibility", known ? "visible" : "hidden");
      if (!known) return;
      this.dots[k].setAttribute("cx", this.across.at(this.x[n]));
      this.dots[k].setAttribute("cy", this.up.at(values[n]));
    });
    const words = this.series.map(({ name, values }) => `${name ? `${name} ` : ""}${short(values[n])}`);
    this.read.textContent = n < 0 ? "\u00a0" : `${this.xLabel === "step" ? "step" : "at"} ${short(this.x[n])}: ${words.join(", ")}`;
  }
}
