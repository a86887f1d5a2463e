// Numbers for people, and elements from text only, so that foreign text can never become markup.

export const $ = (id) => document.getElementById(id);

/** Return an element with properties and children; strings become text. */
export function make(name, properties = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key.startsWith("aria-") || key === "role" || key.startsWith("data-")) element.setAttribute(key, value);
    else element[key] = value;
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/**
 * Replace an element's children only if its key changes, so that a screen reader keeps its place in a list.
 * A focused child with an id is focused again, so that keyboard users do not lose their place.
 */
export function fill(element, key, build) {
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  const held = element.contains(document.activeElement) ? document.activeElement.id : "";
  element.replaceChildren(...build());
  if (held) document.getElementById(held)?.focus({ preventScroll: true });
}

export const count = (value) => Number(value).toLocaleString("en").replaceAll(",", "\u202f");

/** "1 line", "3 lines". */
export const counted = (value, noun) => `${count(value)} ${noun}${Number(value) === 1 ? "" : "s"}`;

/** Why there is no picture of a camera, or only an old one, and what to do. */
export function noLines(status, isEmpty) {
  if (status.state === "faulted") return "No lines: the instrument has failed. Disarm it, then arm it again.";
  if (status.run_id) return "Waiting for lines.";
  return isEmpty ? "No lines: arm the instrument." : "Not live: these are the last lines before the instrument was disarmed.";
}

export function quantity(value, unit) {
  for (const [factor, prefix] of [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"]])
    if (Math.abs(value) >= factor) return `${Number((value / factor).toPrecision(3))}\u202f${prefix}${unit}`;
  for (const [factor, prefix] of [[1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"]])
    if (Math.abs(value) >= factor) return `${Number((value / factor).toPrecision(3))}\u202f${prefix}${unit}`;
  return `0\u202f${unit}`;
}

export function duration(seconds) {
  if (!(seconds < 1e12)) return "–";
  for (const [name, length] of [["days", 86400], ["h", 3600], ["min", 60]])
    if (seconds >= 2 * length) return `${Number((seconds / length).toPrecision(3))}\u202f${name}`;
  if (seconds > 0 && seconds < 0.1) return quantity(seconds, "s");
  return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)}\u202fs`;
}

export const clock = (text) => new Date(text).toLocaleTimeString("en-GB");
export const day = (ns) => new Date(Number(ns) / 1e6).toLocaleString("en-GB");
export const percent = (part) => `${(100 * part).toFixed(part > 0 && part < 0.1 ? 1 : 0)}\u202f%`;
