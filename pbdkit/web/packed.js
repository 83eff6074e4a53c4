/** Arrays as `packing.py` writes them: base64, gzip, all lowest bytes first. */

const ARRAYS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, u1: Uint8Array };

/** The same content with typed arrays in place of what is packed. */
export async function unpacked(content) {
  if (Array.isArray(content)) return Promise.all(content.map(unpacked));
  if (content === null || typeof content !== "object") return content;
  if (content.packed) return array(content);
  const entries = Object.entries(content).map(async ([key, part]) => [key, await unpacked(part)]);
  return Object.fromEntries(await Promise.all(entries));
}

async function array({ packed, data }) {
  const zipped = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const stream = new Blob([zipped]).stream().pipeThrough(new DecompressionStream("gzip"));
  const places = new Uint8Array(await new Response(stream).arrayBuffer());
  const Kind = ARRAYS[packed], size = Kind.BYTES_PER_ELEMENT, count = places.length / size;
  const bytes = new Uint8Array(places.length);
  for (let k = 0; k < size; k++) {
    for (let n = 0; n < count; n++) bytes[n * size + k] = places[k * count + n];
  }
  return new Kind(bytes.buffer);
}
