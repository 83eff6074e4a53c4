/** Interactive simulation: the view of the lattice, and beside it the controls and parameters. */

import { short } from "./chart.js";
import { KINDS, KIND_NAMES } from "./colours.js";
import { choice, labelled, make } from "./dom.js";
import { numberRow, slider } from "./live_numbers.js";
import { pictureIn } from "./live_picture.js";
import { handle } from "./live_tools.js";
import { RANGES, SCALES, legend, none, scaleOf, symmetric, widen } from "./scale.js";
import { sidesOf, wholeTriangles } from "./tears.js";
import { LatticeView } from "./view.js";

const FASTEST = 1000; // steps a picture
const SAID_MS = 8000; // time for which a message is shown
const WRITTEN_MS = 100; // time between two updates of the panel
const SMOOTH = 2000; // number of particles up to which edges are drawn smoothly
const MOST_BONDS = 10000, CLOSE = 10; // more bonds are drawn if their ends are this many pixels apart
const HIDDEN = 2;
const ROOM = 0.1; // around the body, of its size
const WORDS = { stable: "stable", slow: "slow", diverging: "diverging", unknown: "not known" };
const HINTS = {
  lead: "Drag a particle to move it.",
  cut: "Draw a line across bonds, or click one.",
};

/**
 * Fill `root`. `send` sends commands to the session. Its messages and pictures (ArrayBuffers) are
 * passed to `hear` and `see` of the returned object; `close` removes the view.
 */
export function mountLive(root, send) {
  const live = { send, root, running: false, step: 0, end: 0, received: 0, drawn: 0, wrote: 0, first: null };
  root.classList.add("pbdkit-live");
  live.say = (text) => say(live, text);
  live.tellValue = () => tellValue(live);
  const gone = (live.gone = new AbortController());
  layOut(live);
  listenToKeys(live, gone.signal);
  const timer = setInterval(() => tellRate(live), 1000);
  return {
    live,
    hear: (message) => HEARD[message.is]?.(live, message),
    see: (buffer) => see(live, buffer),
    lost: () => say(live, "The session has ended.", true),
    close() {
      clearInterval(timer);
      gone.abort();
      live.view?.close();
      root.replaceChildren();
    },
  };
}

const HEARD = {
  scene(live, scene) {
    live.view?.close();
    live.scene = scene;
    live.title.textContent = scene.name;
    const bonds = numbersIn(scene.bonds, Uint32Array), triangles = numbersIn(scene.triangles, Uint32Array);
    const beyond = scene.beyond ? numbersIn(scene.beyond, Float32Array) : null;
    try {
      const { count, spacing } = scene;
      // The view takes the context that is there. Without a graphics card each smooth edge costs.
      const antialias = count <= SMOOTH;
      live.canvas.getContext("webgl2", { antialias, alpha: false, depth: false });
      live.view = new LatticeView(live.canvas, { count, bonds, spacing, triangles, beyond });
      live.sides = sidesOf(triangles, bonds, count);
      live.triangles = triangles;
    } catch (error) {
      say(live, error.message, true);
      return;
    }
    live.fresh = true;
    live.view.onmove = () => live.draw();
    handle(live, live.view.gone.signal);
    live.rows = scene.numbers.map((number) => numberRow(number, live.send));
    live.numbers.replaceChildren(...live.rows.map((row) => row.element));
    live.colour.replaceChildren(
      make("option", { value: "kind" }, "kind"),
      ...Object.entries(scene.fields).map(([value, { meaning }]) => make("option", { value }, meaning)),
    );
    const thinned = `Each point represents ${scene.every ** 2} particles; all are stepped.`;
    live.thinned.textContent = scene.every > 1 ? thinned : "";
  },
  standing(live, now) {
    Object.assign(live, { running: now.running, now });
    live.play.textContent = now.running ? "Pause" : "Play";
    live.play.setAttribute("aria-pressed", now.running);
    live.speed.value = Math.log(now.speed) / Math.log(FASTEST);
    live.speedText.textContent = `${now.speed} step${now.speed > 1 ? "s" : ""} per picture`;
    if (live.colour.value !== now.colour) live.limits = none(); // another page may have selected it
    live.colour.value = now.colour;
    for (const row of live.rows ?? []) row.show(now.numbers[row.name]);
    if (live.view) live.view.setColours(now.colour === "kind" ? "kind" : "values");
    live.draw();
  },
  judgement(live, { word, why }) {
    live.word.textContent = WORDS[word];
    live.word.dataset.word = word;
    live.why.textContent = why;
  },
  error(live, { text }) {
    say(live, text, true);
    for (const row of live.rows ?? []) row.show(live.now?.numbers[row.name]);
  },
  note(live, { text }) {
    say(live, text);
  },
  saved(live, { path, text, steps }) {
    say(live, `${steps} steps written to ${path}`);
    live.download.hidden = text === null;
    if (text === null) return;
    URL.revokeObjectURL(live.download.href);
    live.download.href = URL.createObjectURL(new Blob([text], { type: "application/yaml" }));
    live.download.download = path.split(/[\\/]/).pop();
  },
};

/** Store a picture; the newest is drawn before the next frame of the screen. */
function see(live, buffer) {
  live.send({ do: "seen" }); // the next can be on its way while this one is drawn
  live.picture = pictureIn(buffer);
  live.received += 1;
  live.first ??= live.picture.made - 1;
  const { kinds, broken } = live.picture;
  if (!live.view) return;
  if (kinds) live.view.setKinds(kinds);
  if (broken) {
    live.broken = broken;
    live.masked = null;
    live.view.setTriangles(wholeTriangles(live.triangles, live.sides, broken));
  }
  live.draw();
}

function numbersIn(text, Kind) {
  return new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
}

function show(live) {
  const { view, picture } = live;
  if (!view || !picture) return;
  Object.assign(live, { step: picture.step, end: picture.end });
  view.setPositions(picture.positions);
  view.setValues(picture.values);
  if (picture.values) setScale(live);
  if (live.fresh) fit(live);
  live.fresh = false;
  maskBonds(live);
  view.draw();
  live.drawn += live.shown !== picture;
  live.shown = picture;
  if (!live.running || performance.now() - live.wrote > WRITTEN_MS) tellStep(live);
  live.marks?.();
}

/** Update the panel: less often than there are pictures, because it takes as long. */
function tellStep(live) {
  const { picture, view } = live;
  live.wrote = performance.now();
  live.stepText.textContent = `step ${picture.step}`;
  live.past.max = picture.end;
  if (document.activeElement !== live.past || live.running) live.past.value = picture.step;
  live.endText.textContent = picture.step < picture.end ? `of ${picture.end}` : "";
  const by = (live.legend.dataset.by = picture.values ? "values" : "kind");
  if (by === "values") live.byValue.replaceChildren(...legend(view.scaleOfValues, fieldOf(live)));
  tellValue(live);
}

/** Draw only broken bonds if there are many at a small distance. */
function maskBonds(live) {
  const { view, scene, broken } = live;
  const many = view.bonds.length / 2 > MOST_BONDS && scene.spacing * view.scale < CLOSE;
  if (!broken || live.masked === many) return;
  live.masked = many;
  view.setBroken(many ? broken.map((bit) => (bit ? 1 : HIDDEN)) : broken);
}

/** Fit the view to the body, with a margin. */
function fit({ view }) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  view.positions.forEach((value, n) => {
    if (!Number.isFinite(value)) return; // of what has diverged
    box[n % 2] = Math.min(box[n % 2], value);
    box[2 + (n % 2)] = Math.max(box[2 + (n % 2)], value);
  });
  const room = ROOM * Math.max(box[2] - box[0], box[3] - box[1]);
  view.fit([box[0] - room, box[1] - room, box[2] + room, box[3] + room]);
}

const fieldOf = ({ scene, now }) => scene.fields[now?.colour] ?? { meaning: "", units: "" };

/** Set the scale of colours: over this picture, or over all since the field was selected. */
function setScale(live) {
  const { picture: { low, high }, view } = live;
  const each = live.ranges.value === "each";
  live.limits = widen(each ? none() : live.limits, [low, high]);
  view.setScale(scaleOf(symmetric(live.limits), live.scales.value));
}

/** Show the value at the particle under the mouse. */
function tellValue({ view, picture, valueText, scene, now }) {
  const value = picture?.values?.[view.selected.particle];
  const units = scene.fields[now?.colour]?.units ?? "";
  valueText.textContent = value === undefined ? "" : `in the ring: ${Number.isNaN(value) ? "no value" : `${short(value)} ${units}`}`;
}

function layOut(live) {
  const { root, send } = live;
  live.canvas = make("canvas", { tabIndex: 0 });
  live.overlay = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  live.title = make("h1");
  live.stepText = make("output", { className: "step" });
  live.endText = make("span", { className: "faint" });
  live.play = button("Play", () => send({ do: "play", on: !live.running }));
  live.past = slider("step to go back to", 0, 0, 1, (step) => send({ do: "rewind", step }));
  live.speedText = make("span");
  live.speed = slider("speed", 0, 1, 0.01, (value) => {
    send({ do: "speed", steps: Math.round(FASTEST ** value) });
  });
  live.limits = none();
  live.colour = choice([], (by) => {
    live.limits = none();
    send({ do: "colour", by });
  });
  live.ranges = choice(RANGES, () => { live.limits = none(); live.draw(); });
  live.ranges.value = "each";
  live.scales = choice(SCALES, () => live.draw());
  live.valueText = make("p", { className: "faint" });
  live.tools = { lead: button("Lead", () => take(live, "lead")) };
  live.tools.cut = button("Cut", () => take(live, "cut"));
  live.hint = make("p", { className: "faint" });
  live.numbers = make("div", { className: "numbers" });
  live.word = make("strong", {}, "…");
  live.why = make("p");
  live.download = make("a", { hidden: true }, "Download");
  live.said = make("p", { className: "said", role: "status" });
  live.rate = make("p", { className: "faint" });
  live.thinned = make("p", { className: "faint" });
  live.legend = legendOf(live);
  const whole = button("Fit view", () => { fit(live); live.draw(); });
  whole.title = "Show the whole body (key f)";
  const body = make("div", { className: "body" }, live.canvas, live.overlay, whole);
  root.replaceChildren(body, make("aside", {}, controls(live), make("footer", {},
    make("div", { className: "judgement" }, "Spectrum: ", live.word, live.why),
    row(button("Save as experiment", () => send({ do: "save" })), live.download),
    live.said, live.rate, live.thinned)));
  take(live, "lead");
  let asked = false; // one picture a screen, however many come
  live.draw = () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; show(live); });
  };
}

function controls(live) {
  const { send } = live;
  const step = button("Step", () => send({ do: "step", count: 1 }));
  const start = button("Start", () => send({ do: "rewind", step: 0 }));
  return make("div", { className: "controls" },
    live.title,
    row(live.stepText, live.endText),
    row(live.play, step, start), live.past,
    labelled("Speed", live.speedText), live.speed,
    row(live.tools.lead, live.tools.cut), live.hint,
    labelled("Colour", live.colour), live.legend,
    make("h2", {}, "Parameters"), live.numbers);
}

function legendOf(live) {
  const dots = KIND_NAMES.map((name, n) => {
    const dot = make("i", { className: "dot" });
    dot.style.background = KINDS[n];
    return make("span", {}, dot, name);
  });
  live.byValue = make("div", { className: "scale" });
  const choices = row(labelled("Range", live.ranges), labelled("Scale", live.scales));
  return make("div", { className: "legend" },
    make("div", { className: "by-kind" }, ...dots),
    make("div", { className: "by-value" }, live.byValue, live.valueText, choices));
}

/** Select the tool of the mouse: "lead" or "cut". */
function take(live, tool) {
  live.tool = live.root.dataset.tool = tool;
  live.hint.textContent = `${HINTS[tool]} The wheel zooms, dragging beside the body moves the picture.`;
  for (const [name, made] of Object.entries(live.tools)) {
    made.setAttribute("aria-pressed", name === tool);
  }
}

function listenToKeys(live, signal) {
  const KEYS = {
    " ": () => live.send({ do: "play", on: !live.running }),
    ArrowRight: () => live.send({ do: "step", count: 1 }),
    ArrowLeft: () => live.send({ do: "rewind", step: Math.max(0, live.step - 1) }),
    Home: () => live.send({ do: "rewind", step: 0 }),
    f: () => { fit(live); live.draw(); },
    c: () => take(live, live.tool === "cut" ? "lead" : "cut"),
  };
  const target = live.root === document.body ? document : live.root;
  target.addEventListener("keydown", (event) => {
    // Text fields and sliders receive all keys; buttons receive the space bar.
    const own = event.target.closest?.(event.key === " " ? "input, select, button" : "input, select");
    if (own || event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
  }, { signal });
}

/** Show the number of pictures per second, and the number that was skipped. */
function tellRate(live) {
  const { picture, drawn, told, now: standing } = live;
  const now = performance.now();
  live.told = { now, drawn };
  if (!told || !picture) return;
  live.perSecond = (1000 * (drawn - told.drawn)) / (now - told.now);
  const all = picture.made - live.first;
  live.lostPictures = Math.max(0, all - drawn);
  const step = picture.stepNs ? `${(picture.stepNs / 1e6).toPrecision(2)} ms per step, ` : "";
  live.rate.textContent = `${live.perSecond.toFixed(0)} pictures per second, ${live.lostPictures} of ` +
    `${all} skipped; ${step}${standing?.engine ?? ""}`;
}

function say(live, text, wrong = false) {
  live.said.textContent = text;
  live.said.classList.toggle("wrong", wrong);
  clearTimeout(live.silence);
  live.silence = setTimeout(() => { live.said.textContent = ""; }, SAID_MS);
}

function button(text, onclick) {
  return make("button", { type: "button", onclick }, text);
}

function row(...parts) {
  return make("div", { className: "row" }, ...parts);
}
