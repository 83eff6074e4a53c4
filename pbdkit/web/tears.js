/** Which bonds are broken at a step, and which triangles are torn with them. */

export class Tears {
  constructor(run) {
    this.run = run;
    this.before = -1;
    this.broken = new Uint8Array(0);
    this.triangles = Uint32Array.from(run.lattice.triangles);
    this.whole = this.triangles;
    this.torn = run.bonds?.broken ? this.#torn() : null;
  }

  /** Looks at the time at that place; whether another number of bonds is broken than before. */
  changed(t) {
    const { run } = this;
    if (!run.bonds) return false;
    this.broken = run.broken(t);
    const count = this.broken.reduce((sum, one) => sum + one, 0);
    if (count === this.before) return false;
    this.before = count;
    if (!this.torn) return true;
    const now = run.times[t];
    this.triangles = this.whole.filter((_, n) => !(this.torn[Math.floor(n / 3)] <= now));
    return true;
  }

  /** The step at which the first side of each triangle broke, NaN where none did. */
  #torn() {
    const { ends, step } = this.run.bonds, count = this.run.count, steps = new Map();
    const key = (a, b) => Math.min(a, b) * count + Math.max(a, b);
    step.forEach((one, n) => { if (one >= 0) steps.set(key(ends[2 * n], ends[2 * n + 1]), one); });
    return Float64Array.from({ length: this.whole.length / 3 }, (_, n) => {
      const [a, b, c] = this.whole.subarray(3 * n, 3 * n + 3);
      const found = [key(a, b), key(b, c), key(c, a)].map((side) => steps.get(side) ?? Infinity);
      const first = Math.min(...found);
      return first < Infinity ? first : NaN;
    });
  }
}
