/** One run as its arrays: where particles are, what they have, how bonds are strained. */

import { KIND_NAMES } from "./colours.js";

const AXES = ["x", "y"];
const TELLING = /^(pe[12]|.*(strain|lagrange|stress|kirchhoff|damage|broken|wear))/;

export class Run {
  /** `lattice` and `bonds` as pages hold them, unpacked. */
  constructor({ lattice, bonds }) {
    Object.assign(this, { lattice, bonds });
    this.times = lattice.times;
    this.count = lattice.reference.length / 2;
    this.colours = [...this.#colours()];
  }

  /** How far a particle is displaced along an axis, 0 or 1, at a place along `times`. */
  u(row, axis, t) { return this.lattice.u[(2 * row + axis) * this.times.length + t]; }

  /** Places at a time, displacements drawn `factor` times as long. */
  positions(t, factor = 1) {
    const found = new Float32Array(2 * this.count), { u, reference } = this.lattice;
    const steps = this.times.length;
    for (let n = 0; n < found.length; n++) found[n] = reference[n] + factor * u[n * steps + t];
    return found;
  }

  kinds(t) {
    const steps = this.times.length;
    return Uint8Array.from({ length: this.count }, (_, n) => this.lattice.kind[n * steps + t]);
  }

  /** 0 for every bond that is whole at a time, 1 for the others. */
  broken(t) {
    return Uint8Array.from(this.bonds.step, (step) => (step >= 0 && step <= this.times[t] ? 1 : 0));
  }

  strain(bond, t) {
    const { ends, rest } = this.bonds, [a, b] = [ends[2 * bond], ends[2 * bond + 1]];
    const now = [0, 1].map((k) => rest[2 * bond + k] + this.u(b, k, t) - this.u(a, k, t));
    return Math.hypot(...now) / Math.hypot(rest[2 * bond], rest[2 * bond + 1]) - 1;
  }

  /** What `value(t)` is at every time. */
  history(value) { return Float64Array.from(this.times, (_, t) => value(t)); }

  number(row) { return this.lattice.labels.number[row]; }

  kindName(row, t) { return KIND_NAMES[this.lattice.kind[row * this.times.length + t]]; }

  /** "12-13": the numbers of a bond's particles. */
  bondName(bond) {
    return [0, 1].map((end) => this.number(this.bonds.ends[2 * bond + end])).join("-");
  }

  /** What particles can be coloured by: {name, meaning, units, at(row, t)}, and a `summary` of all. */
  *#colours() {
    const { length, variables, summary } = this.lattice;
    const displacement = { name: "u", meaning: "displacement", units: length, summary };
    yield* this.#vector(displacement, (row, axis, t) => this.u(row, axis, t));
    for (const variable of variables) {
      const { vector, values } = variable;
      const steps = values.length / this.count / (vector ? 2 : 1);
      const time = (t) => (steps > 1 ? t : 0);
      if (vector) {
        const at = (row, axis, t) => values[(2 * row + axis) * steps + time(t)];
        yield* this.#vector(variable, at);
      } else yield { ...variable, at: (row, t) => values[row * steps + time(t)] };
    }
    if (this.bonds?.broken) yield this.#firstBroken();
  }

  /**
   * The field that tells most: the first of energy, strain, stress or damage that varies, else the
   * displacement, else null.
   */
  telling() {
    const varies = ({ summary }) => {
      const low = Math.min(...summary?.least ?? [0]), high = Math.max(...summary?.largest ?? [0]);
      return high > low;
    };
    return this.colours.find((colour) => TELLING.test(colour.name) && varies(colour)) ??
      this.colours.find((colour) => colour.name === "u" && varies(colour)) ?? null;
  }

  *#vector({ name, meaning, units, summary }, at) {
    const length = (row, t) => Math.hypot(at(row, 0, t), at(row, 1, t));
    yield { name, meaning: `${meaning}, length`, units, summary, at: length };
    for (const k of [0, 1]) {
      const one = { name: `${name}_${AXES[k]}`, meaning: `${meaning}, ${AXES[k]}`, units };
      yield { ...one, at: (row, t) => at(row, k, t) };
    }
  }

  #firstBroken() {
    const first = new Float64Array(this.count).fill(NaN);
    this.bonds.step.forEach((step, bond) => {
      for (const row of this.bonds.ends.subarray(2 * bond, 2 * bond + 2)) {
        if (step >= 0 && !(step >= first[row])) first[row] = step;
      }
    });
    const at = (row, t) => (first[row] <= this.times[t] ? first[row] : NaN);
    return { name: "broken_step", meaning: "step in which its first bond broke", units: "step", at };
  }
}
