/** Details of the selected particle or bond. */

import { Chart, FEW, short } from "./chart.js";
import { make, table } from "./dom.js";

/** Details of a particle: values at the current step, and histories. */
export class ParticleStory {
  constructor(place, run, row, colour, pick) {
    Object.assign(this, { run, row, colour });
    const { labels, length } = run.lattice;
    const index = ["i", "j"].filter((n) => labels[n]).map((n) => `${n} = ${labels[n][row]}`);
    const title = `Particle ${run.number(row)}`;
    this.numbers = make("div");
    place.replaceChildren(make("h3", {}, title), make("p", {}, index.join(", ")), this.numbers);
    const series = ["x", "y"].map((name, axis) => ({
      name: `u_${name}`, values: run.history((t) => run.u(row, axis, t)),
    }));
    const shown = { x: run.times, yLabel: length, pick };
    this.charts = [];
    if (run.times.length <= FEW) return; // the table holds all
    this.charts.push(new Chart(place, { title: "displacement", series, ...shown }));
    if (colour && !/^u(_[xy])?$/.test(colour.name)) {
      const values = run.history((t) => colour.at(row, t));
      const told = { title: colour.meaning, series: [{ name: "", values }] };
      this.charts.push(new Chart(place, { ...shown, ...told, yLabel: colour.units }));
    }
  }

  setStep(t) {
    const { run, row } = this, { reference } = run.lattice;
    const place = [0, 1].map((k) => short(reference[2 * row + k] + run.u(row, k, t), 6));
    const rows = [["step", run.times[t]], ["kind", run.kindName(row, t)], ["x, y", place.join(", ")]];
    for (const { name, units, at } of run.colours) rows.push([name, `${short(at(row, t), 6)} ${units}`]);
    this.numbers.replaceChildren(table([], rows));
    for (const chart of this.charts) chart.setNow(t);
  }
}

/** Details of a bond, as in `pbdkit explain --bond`: its state, and adjacent broken bonds. */
export class BondStory {
  constructor(place, run, bond, pick) {
    const values = run.history((t) => run.strain(bond, t)), limit = run.bonds.limit[bond];
    const series = [{ name: "strain", values }];
    if (Number.isFinite(limit)) series.push({ name: "breaks above", values: values.map(() => limit) });
    const words = [...told(run, bond, values, limit)].map((line) => make("li", {}, line));
    place.replaceChildren(make("h3", {}, `Bond ${run.bondName(bond)}`), make("ul", {}, ...words));
    this.chart = run.times.length > FEW
      ? new Chart(place, { title: "strain", x: run.times, series, pick }) : null;
  }

  setStep(t) { this.chart?.setNow(t); }
}

function* told(run, bond, strains, limit) {
  const { bonds, times } = run, step = bonds.step[bond];
  const state = bonds.states[bonds.state[bond]];
  const length = Math.hypot(bonds.rest[2 * bond], bonds.rest[2 * bond + 1]);
  yield `Shell ${bonds.shell[bond]}, rest length ${short(length, 6)}.`;
  if (state === "broken") {
    const strain = Number.isFinite(bonds.strain[bond]) ? short(bonds.strain[bond], 6) : "an unknown strain";
    yield `It broke in step ${step} at strain ${strain}, bond ${bonds.order[bond]} of ${bonds.broken} in the order of breaking.`;
  } else if (state === "cut") yield `It was cut at the beginning of step ${step}.`;
  else if (state === "broken from the start") yield "It is broken from the start.";
  else yield state === "intact" ? "It is intact at the end." : "It cannot break.";
  if (Number.isFinite(limit)) yield `Fracture model ${bonds.model}: it breaks above the strain ${short(limit, 6)}.`;
  let most = 0;
  strains.forEach((strain, t) => { if (strain > strains[most]) most = t; });
  yield `Largest strain in the steps shown: ${short(strains[most], 6)}, in step ${times[most]}.`;
  for (const [name, values] of Object.entries(bonds.remembered)) {
    yield `${name} at the end: ${short(values[bond], 6)}.`;
  }
  if (bonds.broken) yield* around(run, bond, step);
}

/** Adjacent bonds: those that broke before it, in the same step and after it. */
function* around(run, bond, step) {
  const { ends, step: steps } = run.bonds, mine = ends.subarray(2 * bond, 2 * bond + 2);
  const others = [...steps.keys()].filter(
    (n) => n !== bond && (mine.includes(ends[2 * n]) || mine.includes(ends[2 * n + 1])),
  );
  const gone = others.filter((n) => steps[n] >= 0).sort((a, b) => steps[a] - steps[b]);
  const list = (some) => some.map((n) => `${run.bondName(n)} (step ${steps[n]})`).join(", ") || "none";
  if (step < 0) yield `Adjacent bonds broken: ${list(gone)}.`;
  else {
    yield `Adjacent bonds broken before: ${list(gone.filter((n) => steps[n] < step))}.`;
    yield `Adjacent bonds broken in the same step: ${list(gone.filter((n) => steps[n] === step))}.`;
    yield `Adjacent bonds broken after: ${list(gone.filter((n) => steps[n] > step))}.`;
  }
  yield `Adjacent bonds not broken: ${others.length - gone.length}.`;
}
