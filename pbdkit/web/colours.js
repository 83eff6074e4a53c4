/** Colours of kinds and of values, the same as in pictures. */

export const KINDS = ["#D55E00", "#0072B2", "#F0E442"]; // leader, follower, frame (Okabe and Ito)
export const KIND_NAMES = ["leader", "follower", "frame"];
export const UNKNOWN = "#C4C4C4"; // where there is no value

const SEQUENTIAL = [
  "#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80", "#5EC962", "#ADDC30", "#FDE725",
];
const DIVERGING = [
  "#143F85", "#2F6DB5", "#7BA9D6", "#C6DBEC", "#F6F6F4", "#F3C9B4", "#DF8A6A", "#BE3F3F", "#7E1226",
];

/** "#RRGGBB" as three numbers from 0 to 1. */
export function rgb(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
}

const table = (diverging) => (diverging ? DIVERGING : SEQUENTIAL);

/** The colour map as `count` RGBA bytes, linear between the colours of its table. */
export function mapped(diverging, count) {
  const stops = table(diverging).map(rgb);
  const bytes = new Uint8Array(4 * count);
  for (let n = 0; n < count; n++) {
    const at = (n / (count - 1)) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    for (let c = 0; c < 3; c++) {
      const value = stops[low][c] + (at - low) * (stops[low + 1][c] - stops[low][c]);
      bytes[4 * n + c] = Math.round(255 * value);
    }
    bytes[4 * n + 3] = 255;
  }
  return bytes;
}

/** The colour map as a CSS gradient from left to right. */
export function gradient(diverging) {
  return `linear-gradient(to right, ${table(diverging).join(", ")})`;
}
