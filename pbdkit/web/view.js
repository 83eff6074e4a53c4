/** The lattice on a canvas: bonds, particles and filled fields by WebGL2. */

import { KINDS, UNKNOWN, mapped, rgb } from "./colours.js";
import { listenToPointers } from "./pointers.js";
import { levelOf, scaleOf } from "./scale.js";
import { FRAGMENT, UNIFORMS, VERTEX } from "./shaders.js";

const LINE = [0.62, 0.62, 0.62, 1];
const FAINT = [0.85, 0.35, 0.3, 0.3]; // broken bonds
const DOT = [0.6, 0.6, 0.6, 0.9]; // particles on a filled field, seen on dark and on white
const MARK = [0.08, 0.08, 0.08, 1];
const WHOLE = 0, BROKEN = 1; // what else `setBroken` takes is hidden
const REACH = 12; // so many pixels from where the mouse is a particle or a bond is still meant

export class LatticeView {
  /**
   * `bonds` are two rows of particles a bond, `triangles` three a triangle: values fill them, up to
   * where `beyond`, the distance of particles from an outline, becomes positive.
   * `spacing` is the distance of neighbours at rest. Throws Error without WebGL2.
   */
  constructor(canvas, { count, bonds, spacing, triangles = null, beyond = null }) {
    Object.assign(this, { canvas, count, bonds, spacing, triangles, beyond });
    this.positions = new Float32Array(2 * count);
    this.kinds = new Uint8Array(count).fill(1);
    this.values = null;
    this.broken = new Uint8Array(bonds.length / 2);
    this.scaleOfValues = scaleOf([0, 1]);
    this.by = "kind";
    this.fills = true;
    this.selected = { particle: -1, bond: -1 };
    this.centre = [0, 0];
    this.scale = 1; // CSS pixels a unit of length
    this.fitted = null; // the box that is shown until somebody pans or zooms
    /** Whether a press there begins to pan; a page that drags particles says no on them. */
    this.pans = () => true;
    /** Whether the mouse was moved between the last press and its release: that was no click. */
    this.dragged = false;
    /** Called after every pan and zoom. */
    this.onmove = () => {};
    this.#start();
    this.#listen();
  }

  setPositions(positions) { this.positions = positions; this.stale.add("positions"); }
  setValues(values) { this.values = values; this.stale.add("values"); }
  /** Sets the scale of values, see `scaleOf`. */
  setScale(scale) {
    this.scaleOfValues = scale;
    this.stale.add("values").add("map");
  }
  setKinds(kinds) { this.kinds = kinds; this.stale.add("kinds"); }
  setBroken(broken) { this.broken = broken; this.stale.add("bonds"); }
  setTriangles(triangles) { this.triangles = triangles; this.stale.add("triangles"); }
  setColours(by) { this.by = by; }
  /** Whether values fill the triangles, if there are any. */
  setFilled(filled) { this.fills = filled; this.stale.add("values"); }
  select(row) { this.selected.particle = row; }
  selectBond(row) { this.selected.bond = row; }

  /** Shows [left, bottom, right, top], or all particles, until somebody pans or zooms. */
  fit(box = this.#bounds()) {
    this.fitted = box;
    this.#show(box);
  }

  toWorld(clientX, clientY) {
    const at = this.canvas.getBoundingClientRect();
    return [
      this.centre[0] + (clientX - at.left - at.width / 2) / this.scale,
      this.centre[1] - (clientY - at.top - at.height / 2) / this.scale,
    ];
  }

  /** Where a place of the lattice is in the window, in CSS pixels. */
  toClient(x, y) {
    const at = this.canvas.getBoundingClientRect();
    return [
      at.left + at.width / 2 + (x - this.centre[0]) * this.scale,
      at.top + at.height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  /** The row of the particle that is meant, or -1. */
  pickParticle(clientX, clientY) {
    const [x, y] = this.toWorld(clientX, clientY);
    const reach = Math.min(REACH, Math.max(0.3 * this.spacing * this.scale, 4)) / this.scale;
    let best = -1, least = reach * reach;
    for (let n = 0; n < this.count; n++) {
      const across = this.positions[2 * n] - x, up = this.positions[2 * n + 1] - y;
      const distance = across * across + up * up;
      if (distance < least) [best, least] = [n, distance];
    }
    return best;
  }

  /** The row of the bond that is meant, or -1; hidden ones are not. */
  pickBond(clientX, clientY) {
    const [x, y] = this.toWorld(clientX, clientY);
    let best = -1, least = (0.5 * REACH / this.scale) ** 2;
    for (let n = 0; n < this.bonds.length / 2; n++) {
      if (this.broken[n] > BROKEN) continue;
      const [ax, ay, bx, by] = this.#ends(n);
      const along = [bx - ax, by - ay];
      const share = ((x - ax) * along[0] + (y - ay) * along[1]) / (along[0] ** 2 + along[1] ** 2);
      const t = Math.min(Math.max(share, 0), 1);
      const distance = (ax + t * along[0] - x) ** 2 + (ay + t * along[1] - y) ** 2;
      if (distance < least) [best, least] = [n, distance];
    }
    return best;
  }

  pan(right, down) {
    this.fitted = null;
    this.centre = [this.centre[0] - right / this.scale, this.centre[1] + down / this.scale];
    this.draw();
    this.onmove();
  }

  /** By a factor, about a place of the window that stays where it is. */
  zoom(factor, clientX, clientY) {
    const [x, y] = this.toWorld(clientX, clientY);
    this.fitted = null;
    this.scale *= factor;
    this.centre = [x + (this.centre[0] - x) / factor, y + (this.centre[1] - y) / factor];
    this.draw();
    this.onmove();
  }

  draw() {
    const { gl, canvas } = this, ratio = devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio);
    const height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      if (this.fitted) this.#show(this.fitted);
    }
    this.#upload();
    gl.viewport(0, 0, width, height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const across = (2 * this.scale * ratio) / width, up = (2 * this.scale * ratio) / height;
    const [x, y] = this.centre;
    gl.uniform4f(this.at.screen, across, up, -x * across, -y * up);
    const coloured = this.by === "values" && this.values !== null;
    const filled = coloured && this.fills && this.triangles?.length > 0;
    if (filled) this.#elements(gl.TRIANGLES, "triangles", { look: 2, shape: 3 });
    const apart = this.spacing * this.scale * ratio;
    if (apart > 3) {
      this.#elements(gl.LINES, "broken", { one: FAINT });
      if (!filled) this.#elements(gl.LINES, "whole", { one: LINE });
    }
    const dense = Math.min(Math.max((apart - 3) / 9, 0), 1); // 0 where particles touch
    const size = Math.max(Math.min(apart * (1.25 - 0.75 * dense), 15 * ratio), 1.5);
    const look = coloured ? 2 : 1, shape = size > 3 ? 1 : 0;
    if (!filled) this.#elements(gl.POINTS, "order", { look, shape, size });
    else if (apart > 8) this.#elements(gl.POINTS, "order", { shape, size: 0.35 * size, one: DOT });
    if (filled) this.#elements(gl.POINTS, "apart", { look, shape, size });
    this.#marks(Math.max(size, 5 * ratio) + 12 * ratio);
  }

  /** Takes the view off its canvas. */
  close() {
    this.watch.disconnect();
    this.gone.abort();
  }

  #ends(bond) {
    const a = 2 * this.bonds[2 * bond], b = 2 * this.bonds[2 * bond + 1], p = this.positions;
    return [p[a], p[a + 1], p[b], p[b + 1]];
  }

  #bounds() {
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let n = 0; n < this.positions.length; n++) {
      const value = this.positions[n], axis = n % 2;
      if (value < box[axis]) box[axis] = value;
      if (value > box[2 + axis]) box[2 + axis] = value;
    }
    return box;
  }

  #show([left, bottom, right, top]) {
    const margin = 2 * this.spacing;
    const { clientWidth, clientHeight } = this.canvas;
    this.centre = [(left + right) / 2, (bottom + top) / 2];
    const across = clientWidth / (right - left + margin);
    this.scale = Math.min(across, clientHeight / (top - bottom + margin)) || 1;
  }

  #start() {
    const gl = (this.gl = this.canvas.getContext("webgl2", { antialias: true }));
    if (!gl) throw new Error("this browser cannot draw with WebGL2");
    const program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getProgramInfoLog(program));
    }
    gl.useProgram(program);
    this.at = Object.fromEntries(UNIFORMS.map((n) => [n, gl.getUniformLocation(program, n)]));
    gl.uniform3fv(this.at.kinds, KINDS.flatMap(rgb));
    gl.uniform3fv(this.at.unknown, rgb(UNKNOWN));
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    this.buffers = {};
    this.sizes = {};
    this.stale = new Set(["positions", "values", "map", "kinds", "bonds", "triangles"]);
    if (this.beyond) this.#attribute(3, "beyond", Float32Array.from(this.beyond), 1);
  }

  #listen() {
    this.gone = new AbortController();
    const { signal } = this.gone;
    listenToPointers(this, signal);
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault(), { signal });
    const back = () => { this.#start(); this.draw(); };
    this.canvas.addEventListener("webglcontextrestored", back, { signal });
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(this.canvas);
  }

  /** Hands what has changed to the GPU. */
  #upload() {
    const { gl, stale } = this;
    if (stale.has("positions")) this.#attribute(0, "positions", this.positions, 2);
    if (stale.has("kinds")) {
      this.#attribute(2, "kinds", Float32Array.from(this.kinds), 1);
      this.#indices("order", inOrder(this.kinds, [2, 1, 0])); // leaders come last, on top
    }
    if (stale.has("values")) this.#attribute(1, "levels", this.#levels(), 1);
    if (stale.has("map")) {
      const bytes = mapped(this.scaleOfValues.signed, 256);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    }
    if (stale.has("bonds")) {
      this.#indices("whole", this.#endsOf(inOrder(this.broken, [WHOLE])));
      this.#indices("broken", this.#endsOf(inOrder(this.broken, [BROKEN])));
    }
    if (stale.has("triangles") && this.triangles) {
      this.#indices("triangles", this.triangles);
      const within = new Uint8Array(this.count);
      for (const row of this.triangles) within[row] = 1;
      this.#indices("apart", inOrder(within, [0])); // no triangle shows their values
    }
    stale.clear();
  }

  #endsOf(bonds) {
    const ends = new Uint32Array(2 * bonds.length);
    bonds.forEach((bond, n) => ends.set(this.bonds.subarray(2 * bond, 2 * bond + 2), 2 * n));
    return ends;
  }

  /** Values from 0 to 1 along the colour map; -1 where there is none. */
  #levels() {
    const levels = new Float32Array(this.count);
    if (!this.values) return levels;
    for (let n = 0; n < this.count; n++) {
      const level = levelOf(this.values[n], this.scaleOfValues);
      levels[n] = Number.isNaN(level) ? -1 : level;
    }
    if (this.beyond && this.fills) this.#fillBeyond(levels);
    return levels;
  }

  /** Gives particles beyond the outline that have none the mean level of their triangles. */
  #fillBeyond(levels) {
    const sums = new Float32Array(this.count), counts = new Uint16Array(this.count);
    const missing = (row) => levels[row] < 0 && this.beyond[row] > 0;
    for (let n = 0; n < this.triangles.length; n += 3) {
      const corners = this.triangles.subarray(n, n + 3);
      const known = corners.filter((row) => levels[row] >= 0);
      if (!known.length || !corners.some(missing)) continue;
      const mean = known.reduce((sum, row) => sum + levels[row], 0) / known.length;
      for (const row of corners.filter(missing)) [sums[row], counts[row]] = [sums[row] + mean, counts[row] + 1];
    }
    for (let row = 0; row < this.count; row++) if (counts[row]) levels[row] = sums[row] / counts[row];
  }

  #attribute(place, name, values, size) {
    const { gl } = this;
    this.buffers[name] ??= gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
  }

  #indices(name, rows) {
    const { gl } = this;
    this.buffers[name] ??= gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[name]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
    this.sizes[name] = rows.length;
  }

  #elements(mode, name, { look = 0, shape = 0, size = 1, one = MARK }) {
    const { gl, at } = this;
    if (!this.sizes[name]) return;
    gl.uniform1i(at.look, look);
    gl.uniform1i(at.shape, shape);
    gl.uniform1f(at.size, size);
    gl.uniform4fv(at.one, one);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[name]);
    gl.drawElements(mode, this.sizes[name], gl.UNSIGNED_INT, 0);
  }

  /** The selected particle in a ring, and the ends of the selected bond with the bond between. */
  #marks(size) {
    const { particle, bond } = this.selected;
    if (particle >= 0) {
      this.#indices("mark", Uint32Array.of(particle));
      this.#elements(this.gl.POINTS, "mark", { shape: 2, size });
    }
    if (bond >= 0) {
      this.#indices("mark", this.#endsOf([bond]));
      this.#elements(this.gl.LINES, "mark", {});
      this.#elements(this.gl.POINTS, "mark", { shape: 2, size: 0.8 * size });
    }
  }
}

/** The rows at which those values stand, one value after the other. */
function inOrder(values, wanted) {
  const rows = new Uint32Array(values.length);
  let found = 0;
  for (const value of wanted) {
    for (let n = 0; n < values.length; n++) if (values[n] === value) rows[found++] = n;
  }
  return rows.subarray(0, found);
}
