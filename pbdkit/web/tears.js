/** Which bonds are broken at a step, and which triangles are torn with them. */

/** The row of the bond on each side of each triangle, -1 where there is none. */
export function sidesOf(triangles, ends, count) {
  const rows = new Map(), key = (a, b) => Math.min(a, b) * count + Math.max(a, b);
  for (let n = 0; n < ends.length / 2; n++) rows.set(key(ends[2 * n], ends[2 * n + 1]), n);
  return Int32Array.from(triangles, (a, n) => {
    const b = triangles[n % 3 === 2 ? n - 2 : n + 1];
    return rows.get(key(a, b)) ?? -1;
  });
}

/** The triangles with no broken bond on their sides. */
export function wholeTriangles(triangles, sides, broken) {
  const torn = (n) => sides[n] >= 0 && broken[sides[n]] > 0;
  return triangles.filter((_, n) => {
    const first = n - (n % 3);
    return !(torn(first) || torn(first + 1) || torn(first + 2));
  });
}

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
    const { ends, step } = this.run.bonds;
    const sides = sidesOf(this.whole, ends, this.run.count);
    return Float64Array.from({ length: this.whole.length / 3 }, (_, n) => {
      const steps = [...sides.subarray(3 * n, 3 * n + 3)].map((bond) => step[bond] ?? -1);
      const first = Math.min(...steps.map((one) => (one >= 0 ? one : Infinity)));
      return first < Infinity ? first : NaN;
    });
  }
}
