/** The scale of a field: its limits, its colours from 0 to 1 between them, and its legend. */

import { short } from "./chart.js";
import { gradient } from "./colours.js";
import { make } from "./dom.js";

export const RANGES = [["all", "all steps"], ["each", "each step"]];
export const SCALES = [["linear", "linear"], ["log", "logarithmic"]];
const SMALLEST = 1e-4; // ratio of the smallest to the largest magnitude on a logarithmic scale

/** A scale between two values. A logarithmic one with negative values is symmetric about zero. */
export function scaleOf([low, high], kind = "linear") {
  if (!(low <= high)) [low, high] = [0, 1];
  const most = Math.max(-low, high), log = kind === "log" && most > 0;
  const signed = low < 0 && (log || high > 0);
  if (signed && log) [low, high] = [-most, most];
  const least = signed ? SMALLEST * most : Math.max(low, SMALLEST * high);
  return { low, high, signed, log, least };
}

/** The place of a value on its scale, from 0 to 1; NaN where there is no value. */
export function levelOf(value, { low, high, signed, log, least }) {
  if (Number.isNaN(value)) return NaN;
  let level = high > low ? (value - low) / (high - low) : 0.5;
  if (log) {
    const size = least < high ? Math.max(Math.log(Math.abs(value) / least) / Math.log(high / least), 0) : 0.5;
    level = signed ? 0.5 + 0.5 * Math.sign(value) * size : (value > 0 ? size : 0);
  }
  return Math.min(Math.max(level, 0), 1);
}

/** Extends two limits to all finite values. */
export function widen(limits, values) {
  for (const value of values) {
    if (value < limits[0] && value > -Infinity) limits[0] = value;
    if (value > limits[1] && value < Infinity) limits[1] = value;
  }
  return limits;
}

/** The limits, made symmetric about zero if there are both signs. */
export function symmetric([low, high]) {
  const most = Math.max(-low, high);
  return low < 0 && high > 0 ? [-most, most] : [low, high];
}

/** Limits that contain no value yet. */
export const none = () => [Infinity, -Infinity];

/** Limits, colours, and the meaning of a field with its units. */
export function legend({ low, high, signed, log, least }, { meaning, units }) {
  const bar = make("span", { className: "bar" });
  bar.style.background = gradient(signed);
  const below = log && !signed && low < least ? "≤ " : "";
  const within = log && signed ? `, logarithmic beyond ±${short(least, 2)}` : log ? ", logarithmic" : "";
  return [make("span", {}, below + short(log && !signed ? least : low)), bar, make("span", {}, short(high)),
    make("span", { className: "means" }, withUnits(meaning, units) + within)];
}

/** "stress (MPa)". */
export function withUnits(meaning, units) { return units ? `${meaning} (${units})` : meaning; }
