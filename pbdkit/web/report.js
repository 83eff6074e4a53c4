/** The page of a run or of a sweep, made of the content that stands in it. */

import { Chart, FEW, short } from "./chart.js";
import { make, section, table } from "./dom.js";
import { LatticePanel } from "./panel.js";
import { unpacked } from "./packed.js";
import { Run } from "./run.js";
import { SweepMap } from "./sweep.js";

const page = document.getElementById("page");

/** Lets the keyboard move the lattice that `current()` gives. */
function listenToKeys(current) {
  document.addEventListener("keydown", (event) => {
    const panel = current();
    if (!panel || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("input, select, textarea, button, summary")) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) {
      panel.pause();
      panel.setStep(panel.t + step);
    } else if (event.key === " ") panel.play();
    else return;
    event.preventDefault();
  });
}

function origin({ facts, experiment, file, what, left_out: leftOut }) {
  const words = facts.map(([name, value]) =>
    make("div", { className: value.length > 50 ? "whole" : "" }, make("dt", {}, name), make("dd", {}, value)));
  const parts = [make("dl", {}, ...words)];
  if (experiment) {
    const save = make("button", { type: "button", onclick: () => {
      const link = URL.createObjectURL(new Blob([experiment], { type: "text/yaml" }));
      make("a", { href: link, download: `${file}.yaml` }).click();
      setTimeout(() => URL.revokeObjectURL(link), 1000);
    } }, `Save as ${file}.yaml`);
    const commands = what === "run"
      ? [`pbdkit run ${file}.yaml -o ${file}.nc`, `# or in Python, from the result:`,
        `pbdkit.rerun(pbdkit.open("${file}.nc"))`]
      : [`pbdkit sweep ${file}.yaml`];
    const name = what === "run" ? "Experiment of this result" : "Sweep";
    parts.push(
      make("details", {}, make("summary", {}, name), make("pre", { tabIndex: 0 }, experiment)),
      make("h3", {}, "Run it again"), make("p", {}, save),
      make("pre", { tabIndex: 0 }, commands.join("\n")),
    );
  }
  if (leftOut.length) {
    parts.push(make("h3", {}, "Omitted from this page"));
    parts.push(make("ul", { id: "left-out" }, ...leftOut.map((line) => make("li", {}, line))));
  }
  return section("Origin", ...parts);
}

/** Charts of curves and of means over the particles; they mark the step of the lattice. */
class Curves {
  constructor(place, { curves, run, pick }) {
    this.charts = [];
    this.run = run;
    for (const { steps, x_label: xLabel, y_label: yLabel, ...rest } of curves) {
      const options = { ...rest, xLabel, yLabel };
      this.#add(place, { ...options, pick: run && ((n) => pick(nearest(run.times, steps[n]))) }, steps);
    }
    for (const { meaning: title, units: yLabel, summary } of run?.colours ?? []) {
      if (summary?.mean.length !== run.times.length || run.times.length <= FEW) continue;
      this.#add(place, { title, x: run.times, yLabel, series: series(summary), pick }, run.times);
    }
  }

  setStep(t) {
    for (const { chart, steps } of this.charts) chart.setNow(nearest(steps, this.run.times[t]));
  }

  #add(place, options, steps) {
    if (options.x.length > FEW) this.charts.push({ chart: new Chart(place, options), steps });
    else if (options.xLabel === "step") place.append(numbersOf(options, steps)); // no pair of these
  }
}

/** The values of a curve of few points as a table, with a column for each step. */
function numbersOf({ title, yLabel, series }, steps) {
  const head = ["", ...[...steps].map((step) => `step ${step}`)];
  const rows = series.map(({ name, values }) => [name, ...[...values].map((value) => short(value))]);
  const caption = make("figcaption", {}, make("strong", {}, title), yLabel ? `(${yLabel})` : "");
  return make("figure", {}, caption, table(head, rows));
}

function nearest(steps, wanted) {
  let best = 0;
  for (let n = 1; n < steps.length; n++) {
    if (Math.abs(steps[n] - wanted) < Math.abs(steps[best] - wanted)) best = n;
  }
  return best;
}

/** Mean and largest value over the particles, and the smallest if there are negative values. */
function series({ mean, largest, least }) {
  const shown = [{ name: "mean", values: mean }, { name: "largest", values: largest }];
  return least.some((value) => value < 0) ? [...shown, { name: "smallest", values: least }] : shown;
}

/** The lattice and the curves of a run, into two places. */
async function show(lattice, charts, { run: content }) {
  const run = content.lattice ? new Run(content) : null;
  let curves = null;
  const panel = run && new LatticePanel(lattice, run, { onstep: (t) => curves?.setStep(t) });
  curves = new Curves(charts, { curves: content.curves, run, pick: (t) => panel.setStep(t) });
  if (panel) curves.setStep(panel.t);
  charts.parentElement.hidden = !charts.childElementCount;
  return panel;
}

/** Append the section first: the width of a chart is that of its parent. */
function convergence({ rows, notes, moves, certificate }) {
  const parts = notes.map((line) => make("p", { className: "note" }, line));
  const words = (value) => (typeof value === "number" ? short(value, 6) : value ?? "not known");
  const happened = (value) => (value === null ? "" : words(value));
  if (rows) {
    const told = rows.map(([what, before, after]) => [what, words(before), happened(after)]);
    parts.unshift(table(["", "predicted", "observed"], told));
  }
  if (certificate) {
    parts.push(table([], certificate.map(([name, value]) => [name, words(value)])));
  }
  const place = make("div", { className: "charts" });
  page.append(section("Prediction and observation", ...parts, place));
  if (moves) new Chart(place, { ...moves, xLabel: moves.x_label, yLabel: moves.y_label });
}

function ledger({ model, bonds, counts, all, step, ends, shell, strain, limit, nearest }) {
  const more = Object.entries(counts).filter(([state, n]) => n && !["intact", "broken"].includes(state));
  const words = [`${counts.broken} of ${bonds} bonds broke`, ...more.map(([state, n]) => `${n} ${state}`)];
  const number = (value) => (Number.isFinite(value) ? short(value, 6) : "not known");
  const limits = limit.some(Number.isFinite);  // A model such as cohesive has none.
  const rows = step.map((one, n) => [
    n + 1, one, ends[n].join("-"), shell[n], number(strain[n]), ...(limits ? [number(limit[n])] : []),
  ]);
  const names = ["order", "step", "bond", "shell", "strain", ...(limits ? ["breaks above"] : [])];
  const listed = rows.length ? table(names, rows) : "";
  if (listed) listed.classList.add("long");
  const near = nearest ? [`Nearest to breaking at the end: bond ${nearest.bond.join("-")}, strain ${number(nearest.strain)}; it breaks above ${number(nearest.breaks_above)}.`] : [];
  const cut = all > rows.length ? [`The first ${rows.length} of ${all} are listed; \`pbdkit explain\` lists all.`] : [];
  return section("Fracture",
    make("p", {}, `Fracture model ${model}: ${words.join(", ")}.`), listed,
    ...[...cut, ...near].map((line) => make("p", { className: "note" }, line)));
}

function speed({ of, on, columns, rows, left_out: leftOut }) {
  return section("Speed against error",
    make("p", {}, `Measured: ${of}; on ${on}.`), table(columns, rows),
    ...[...leftOut, ...columns.filter(([, meaning]) => meaning).map((pair) => pair.join(": "))]
      .map((line) => make("p", { className: "note" }, line)));
}

async function runPage(content) {
  const lattice = section("Lattice"), charts = make("div", { className: "charts" });
  const whole = await unpacked(content);
  page.append(origin(content), lattice, section("Curves", charts));
  const panel = await show(lattice, charts, whole);
  listenToKeys(() => panel);
  convergence(whole.convergence);
  if (whole.ledger) page.append(ledger(whole.ledger));
}

async function sweepPage(content) {
  const map = section("Map"), below = make("div");
  const shared = await unpacked(content.shared);
  let panel = null;
  listenToKeys(() => panel);
  page.append(origin(content), map, below);
  const { grid, status, message, members } = content, scalars = await unpacked(content.scalars);
  const open = async (n, name) => {
    panel?.close();
    panel = null;
    const member = await unpacked(members[n]);
    const lattice = section(`Member: ${name}`, make("p", {}, [status[n], message[n]].filter(Boolean).join(": ")));
    const charts = make("div", { className: "charts" });
    below.replaceChildren(lattice, section("Curves", charts));
    if (!member) return;
    const run = { curves: member.curves };
    if (member.lattice) {
      run.lattice = { ...shared.lattice, ...member.lattice };
      run.bonds = member.bonds && { ...shared.bonds, ...member.bonds };
    }
    panel = await show(lattice, charts, { run });
    lattice.scrollIntoView({ block: "nearest" });
  };
  new SweepMap(map, { grid, status, message, scalars, open });
}

async function main() {
  const content = JSON.parse(document.getElementById("content").textContent);
  page.replaceChildren(make("h1", {}, content.title));
  await (content.what === "sweep" ? sweepPage : runPage)(content);
  if (content.speed) page.append(speed(content.speed));
  page.dataset.ready = "yes";
}

main().catch((error) => {
  page.append(make("p", { className: "fault", role: "alert" }, `This page cannot be shown: ${error.message}`));
  throw error;
});
