// Health, beside the tables of checks: latencies, the examination of the host, and the end of the daemon's log.

import { MARKS, table } from "./facts.js";
import { ask } from "./link.js";
import { $, clock, counted, duration, fill, make } from "./words.js";

const EVERY_MS = 2000;
const LOG_MARKS = { warning: ["warning", "! warning"], error: ["bad", "✗ error"], critical: ["bad", "✗ critical"] };

/** How old the newest of everything is: lines by the pictures that come anyway, the rest by the daemon's status. */
export class Latencies {
  #arms = {}; #run = null;

  rows(header) { this.#arms[header.arm] = performance.now() - header.age_ms; }

  show(status, liveError) {
    if (status.run_id !== this.#run) { this.#run = status.run_id; this.#arms = {}; }
    if ($("health").hidden) return;
    const facts = Object.keys(status.run_id ? status.arms : { a: 0, b: 0 }).map((arm) => [`newest line of arm ${arm.toUpperCase()}`, this.#line(arm, liveError)]);
    facts.push(["newest lines on disk", onDisk(status)]);
    facts.push(["last message of the trigger", status.trigger ? `${age(status.trigger.silent_s)} ago` : "– (not armed)"]);
    fill($("latencies"), JSON.stringify(facts), () => facts.flatMap(([term, text]) => [make("dt", {}, term), make("dd", {}, text)]));
  }

  #line(arm, liveError) {
    if (this.#run === null) return "– (not armed)";
    if (liveError) return "unknown: the lines cannot be read";
    return arm in this.#arms ? `${age((performance.now() - this.#arms[arm]) / 1000)} old` : "none has come yet";
  }
}

const age = (seconds) => duration(seconds < 0.1 ? Math.max(1, Math.round(1000 * seconds)) / 1000 : seconds);

function onDisk({ recording, arms }) {
  if (!recording) return "– (nothing is being recorded)";
  const left = recording.recorded_lines - recording.committed_lines, rate = Math.min(...Object.values(arms).map((arm) => arm.rate_hz));
  const behind = left > 0 && rate > 0 ? ` (${age(left / rate)})` : "";
  return `${recording.commit_age_s === null ? "none yet" : `${age(recording.commit_age_s)} ago`}; ${counted(left, "recorded line")}${behind} not readable yet`;
}

/** The findings of the latest examination, for everybody; only an operator can ask for another. */
export class Checkup {
  #fail; #operator = false; #running = false;

  constructor(fail) { this.#fail = fail; $("examine").onclick = () => this.#examine(); }

  enter(operator) { this.#operator = operator; this.#enable(); }

  async show() {
    try { this.#list(await ask("GET", "doctor")); }
    catch (error) { this.#fail(error.message); }
  }

  async #examine() {
    this.#fail("");
    this.#running = true; this.#enable();
    $("examined").textContent = "Examining …";
    try { this.#list(await ask("POST", "doctor")); }
    catch (error) { $("examined").textContent = ""; this.#fail(error.message); }
    finally { this.#running = false; this.#enable(); }
  }

  #enable() { $("examine").disabled = !this.#operator || this.#running; }

  #list({ examined, running, findings }) {
    const bad = findings.filter((one) => one.level !== "good").length;
    $("examined").textContent = running || this.#running && !examined ? "Examining …" : !examined ? "Not examined since the page started."
      : `${new Date(examined).toLocaleString("en-GB")}: ${bad ? `${bad} of ${counted(findings.length, "finding")} ${bad === 1 ? "is" : "are"} not good` : "all is good"}.`;
    fill($("findings"), JSON.stringify(findings), () => findings.length ? [table(["check", "", "result", "what to do"], findings.map((one) =>
      [one.name, make("span", { className: one.level }, MARKS[one.level]), one.text, one.level === "good" ? "" : one.todo]))] : []);
  }
}

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
      const [level, mark] = LOG_MARKS[entry.level] ?? ["", ""];
      return make("li", {}, entry.time ? make("time", { dateTime: entry.time }, clock(entry.time)) : null, mark ? make("b", { className: level }, `${mark} `) : null, entry.text);
    }) : [make("li", {}, "Nothing yet.")]);
  }
}
