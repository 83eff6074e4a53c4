/** A picture as the session sends it, pbdkit/sessions/frames.py. */

const HEAD = 48, VALUES = 1, KINDS_TOO = 2, BROKEN_TOO = 4;

export function pictureIn(buffer) {
  const head = new DataView(buffer);
  const [holds, step, end, made, stepNs, count, bonds] =
    Array.from({ length: 7 }, (_, n) => head.getUint32(4 * n, true));
  let at = HEAD;
  const take = (Kind, length) => {
    const found = new Kind(buffer, at, length);
    at += found.byteLength;
    return found;
  };
  const positions = take(Float32Array, 2 * count);
  const values = holds & VALUES ? take(Float32Array, count) : null;
  const kinds = holds & KINDS_TOO ? take(Uint8Array, count) : null;
  const broken = holds & BROKEN_TOO ? take(Uint8Array, bonds) : null;
  const low = head.getFloat64(32, true), high = head.getFloat64(40, true);
  return { step, end, made, stepNs, positions, values, kinds, broken, low, high };
}
