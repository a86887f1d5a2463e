// Health, beside the tables of checks: the end of the daemon's log.

import { ask } from "./link.js";
import { $, clock, fill, make } from "./words.js";

const EVERY_MS = 2000;
const MARKS = { warning: ["warning", "! warning"], error: ["bad", "✗ error"], critical: ["bad", "✗ critical"] };

/** Asks while the screen is shown, and only then. */
export class LogTail {
  #asking = false;

  constructor() { setInterval(() => this.show(), EVERY_MS); }

  async show() {
    if ($("health").hidden || this.#asking || document.visibilityState !== "visible" || document.body.dataset.stale !== undefined) return;
    this.#asking = true;
    try { this.#list((await ask("GET", "log")).entries); }
    catch (error) { this.#list([{ level: "error", text: `The log cannot be read: ${error.message}` }]); }
    finally { this.#asking = false; }
  }

  #list(entries) {
    fill($("log"), JSON.stringify(entries), () => entries.length ? entries.toReversed().map((entry) => {
      const [level, mark] = MARKS[entry.level] ?? ["", ""];
      return make("li", {}, entry.time ? make("time", { dateTime: entry.time }, clock(entry.time)) : null, mark ? make("b", { className: level }, `${mark} `) : null, entry.text);
    }) : [make("li", {}, "Nothing yet.")]);
  }
}
