/** The moving lattice with its controls, and beside it what was clicked. */

import { KINDS, KIND_NAMES } from "./colours.js";
import { choice, labelled, make } from "./dom.js";
import { RANGES, SCALES, legend, none, scaleOf, symmetric, widen } from "./scale.js";
import { BondStory, ParticleStory } from "./story.js";
import { Tears } from "./tears.js";
import { LatticeView } from "./view.js";

const STEPS_A_SECOND = 25;
const SMALL_PART = 0.1; // of the scale of all steps; the scale of each step is shown instead
const HINT = "Click a particle or a bond. The wheel or two fingers zoom; dragging moves the picture.";

export class LatticePanel {
  /** `onstep(t)` is called with the index of the time that is shown. */
  constructor(place, run, { onstep = () => {} } = {}) {
    Object.assign(this, { run, onstep, t: 0, colour: null, range: "all", factor: 1 });
    this.canvas = make("canvas", { role: "img", "aria-label": "the lattice" });
    this.beside = make("aside", {}, make("p", { className: "note" }, HINT));
    this.scale = make("div", { className: "scale" });
    this.#controls();
    const left = make("div", { className: "body" }, this.choices, this.canvas, this.time, this.scale);
    place.append(make("div", { className: "lattice" }, left, this.beside));
    const { box, spacing, triangles, beyond } = run.lattice, bonds = run.bonds?.ends ?? [];
    const shape = (box[2] - box[0] + spacing) / (box[3] - box[1] + spacing);
    this.canvas.style.aspectRatio = Math.min(Math.max(shape, 0.75), 4);
    const rows = { bonds: Uint32Array.from(bonds), triangles: Uint32Array.from(triangles) };
    this.view = new LatticeView(this.canvas, { count: run.count, spacing, beyond, ...rows });
    this.tears = new Tears(run);
    this.canvas.addEventListener("click", (event) => this.#click(event));
    this.view.fit(box);
    this.setColour(run.telling()?.name ?? "kind");
    this.setStep(run.times.length - 1);
  }

  /** Shows the state at a place along the run's times. */
  setStep(t) {
    const { run, view } = this;
    this.t = t = Math.min(Math.max(t, 0), run.times.length - 1);
    view.setPositions(run.positions(t, this.factor));
    view.setKinds(run.kinds(t));
    if (this.tears.changed(t)) {
      view.setBroken(this.tears.broken);
      view.setTriangles(this.tears.triangles);
    }
    this.slider.value = t;
    this.slider.setAttribute("aria-valuetext", `step ${run.times[t]}`);
    this.read.textContent = `step ${run.times[t]}`;
    this.#paint();
    this.story?.setStep(t);
    this.onstep(t);
  }

  /** Set colours by "kind" or by the name of a variable. */
  setColour(name) {
    this.colour = this.run.colours.find((colour) => colour.name === name) ?? null;
    this.colours.value = name;
    for (const control of [this.rangeChoice, this.scaleChoice, this.fill]) control.hidden = !this.colour;
    this.whole = null;
    if (this.colour && !this.choseRange) this.ranges.value = this.range = this.#hasDecayed() ? "each" : "all";
    this.#paint();
    if (this.row !== undefined) this.showParticle(this.row);
  }

  showParticle(row) {
    this.row = row;
    this.story = new ParticleStory(this.beside, this.run, row, this.colour, (t) => this.setStep(t));
    this.#select(row, -1);
  }

  showBond(bond) {
    this.row = undefined;
    this.story = new BondStory(this.beside, this.run, bond, (t) => this.setStep(t));
    this.#select(-1, bond);
  }

  play() {
    if (this.playing) return this.pause();
    if (this.t === this.run.times.length - 1) this.setStep(0);
    this.playing = true;
    this.button.textContent = "Pause";
    let before = performance.now();
    const go = (now) => {
      if (!this.playing || !this.canvas.isConnected) return;
      const due = Math.floor(((now - before) / 1000) * STEPS_A_SECOND);
      if (due > 0) {
        before = now;
        this.setStep(this.t + due);
      }
      if (this.t === this.run.times.length - 1) this.pause();
      else requestAnimationFrame(go);
    };
    requestAnimationFrame(go);
  }

  pause() {
    this.playing = false;
    this.button.textContent = "Play";
  }

  close() {
    this.pause();
    this.view.close();
  }

  #controls() {
    const { run } = this, last = run.times.length - 1;
    const names = run.colours.map(({ name, meaning }) => [name, meaning]);
    this.colours = choice([["kind", "kind"], ...names], (name) => this.setColour(name));
    this.ranges = choice([...RANGES, ["typed", "custom"]], (range) => {
      Object.assign(this, { range, choseRange: true });
      this.#paint();
    });
    this.bounds = ["from", "to"].map((end) => make("input", {
      type: "number", step: "any", "aria-label": `${end} value`, hidden: true,
      onchange: () => this.#paint(),
    }));
    this.rangeChoice = labelled("Range", this.ranges, ...this.bounds);
    this.scales = choice(SCALES, () => this.#paint());
    this.scaleChoice = labelled("Scale", this.scales);
    this.filling = make("input", { type: "checkbox", onchange: () => this.#paint() });
    this.filling.checked = run.count > 400;
    this.fill = labelled("Fill", this.filling);
    const drawn = make("input", { type: "number", min: "0", step: "any", value: "1", onchange: () => {
      this.factor = Number(drawn.value) || 0;
      this.setStep(this.t);
      this.#showAll();
    } });
    const whole = make("button", { type: "button", onclick: () => this.#showAll() }, "Show all");
    this.find = make("input", { type: "text", placeholder: "particle 12 or bond 12 13", onchange: () => this.#search() });
    this.choices = make("div", { className: "choices" },
      labelled("Colour", this.colours), this.rangeChoice, this.scaleChoice, this.fill,
      labelled("Displacement factor", drawn), labelled("Find", this.find), whole);
    const act = () => this.play();
    this.button = make("button", { type: "button", onclick: act, disabled: !last }, "Play");
    this.slider = make("input", {
      type: "range", min: 0, max: last, step: 1, disabled: !last, "aria-label": "step",
      oninput: () => { this.pause(); this.setStep(Number(this.slider.value)); },
    });
    this.read = make("output", {}, "");
    this.time = make("div", { className: "time" }, this.button, this.slider, this.read);
  }

  /** Fit the view to all steps, or to this step if displacements are magnified. */
  #showAll() {
    this.view.fit(this.factor === 1 ? this.run.lattice.box : undefined);
    this.view.draw();
  }

  /** Select a particle by its number, or a bond by the numbers of its particles. */
  #search() {
    const rows = (this.find.value.match(/\d+/g) ?? []).map((n) =>
      this.run.lattice.labels.number.indexOf(Number(n)));
    const { ends } = this.run.bonds ?? { ends: [] };
    const bond = [...ends.keys()].findIndex((n) =>
      n % 2 === 0 && rows.includes(ends[n]) && rows.includes(ends[n + 1]));
    if (rows.length === 1 && rows[0] >= 0) this.showParticle(rows[0]);
    else if (rows.length === 2 && bond >= 0 && rows[0] !== rows[1]) this.showBond(bond / 2);
    else {
      this.story = null;
      const what = rows.length === 2 ? "No bond between these is shown." : "No such particle is shown.";
      this.beside.replaceChildren(make("p", { className: "note" }, what));
    }
  }

  #click(event) {
    if (this.view.dragged) return;
    const row = this.view.pickParticle(event.clientX, event.clientY);
    if (row >= 0) return this.showParticle(row);
    const bond = this.view.pickBond(event.clientX, event.clientY);
    if (bond >= 0) this.showBond(bond);
  }

  #select(row, bond) {
    this.view.select(row);
    this.view.selectBond(bond);
    this.story.setStep(this.t);
    this.view.draw();
  }

  /** Hands the colours of this step to the view, draws it, and explains the colours below. */
  #paint() {
    const { view, colour, t } = this;
    for (const input of this.bounds) input.hidden = this.range !== "typed";
    view.setColours(colour ? "values" : "kind");
    view.setFilled(this.filling.checked);
    if (!colour) this.#kindScale();
    else {
      const values = this.#valuesAt(t);
      const scale = this.#scaleOf(values);
      view.setValues(values);
      view.setScale(scale);
      this.scale.replaceChildren(...legend(scale, colour));
    }
    view.draw();
  }

  #kindScale() {
    const present = new Set(this.run.lattice.kind);
    this.scale.replaceChildren(...KIND_NAMES.map((name, kind) => {
      const item = make("span", { className: "kind" }, name);
      item.style.setProperty("--colour", KINDS[kind]);
      return present.has(kind) ? item : "";
    }));
  }

  /** The scale of the colours: over the range that is selected, linear or logarithmic. */
  #scaleOf(values) {
    const kind = this.scales.value;
    if (this.range === "typed" && this.bounds.every((input) => input.value !== "")) {
      return scaleOf(this.bounds.map((input) => Number(input.value)), kind);
    }
    const limits = this.range === "each" ? widen(none(), values) : (this.whole ??= this.#ofAll());
    const scale = scaleOf(symmetric(limits), kind);
    this.bounds.forEach((input, end) => {
      input.value = Number([scale.low, scale.high][end].toPrecision(4));
    });
    return scale;
  }

  /** Whether the values of the last step would take a small part of the scale of all steps. */
  #hasDecayed() {
    const width = (limits) => { const { low, high } = scaleOf(symmetric(limits)); return high - low; };
    const last = widen(none(), this.#valuesAt(this.run.times.length - 1));
    return width(last) < SMALL_PART * width(this.#ofAll());
  }

  #ofAll() {
    const limits = none(), { summary } = this.colour;
    if (summary) return widen(widen(limits, summary.least), summary.largest);
    for (let t = 0; t < this.run.times.length; t++) widen(limits, this.#valuesAt(t));
    return limits;
  }

  #valuesAt(t) {
    return Float32Array.from({ length: this.run.count }, (_, row) => this.colour.at(row, t));
  }
}
