// The main screen: both arms, the commands, the ledger of the lines, and the events.

import { ask } from "./link.js";
import { Histogram, SHOWN_S, Waterfall } from "./waterfall.js";
import { $, clock, count, counted, duration, fill, make, noLines, percent, quantity } from "./words.js";

const HOLD_MS = 600;
const MOST_EVENTS = 60;
/** Button → the daemon's command. */
const COMMANDS = { arm: "arm", record: "start", mark: "mark", stop: "stop", disarm: "disarm" };

export class Watch {
  #arms = {}; #possible = new Set(); #operator = null; #fail; #hold = null; #setup = null; #events = [];
  #status = null; #unknown = "the page is still connecting to the instrument"; #refused = null;

  constructor(fail) {
    this.#fail = fail;
    this.#enable();
    for (const arm of ["a", "b"]) this.#arms[arm] = new Arm(arm);
    $("arms").replaceChildren(...Object.values(this.#arms).map((arm) => arm.element));
    $("arm").onclick = () => this.#do("arm");
    $("record").onclick = () => this.#record();
    $("mark").onclick = () => this.#mark();
    $("disarm").onclick = () => this.#do("disarm");
    $("mark-text").addEventListener("keydown", (event) => { if (event.key === "Enter") this.#mark(); });
    const stop = $("stop");
    stop.append(make("span", { className: "held", "aria-hidden": "true" }));
    stop.addEventListener("pointerdown", () => this.holdStop());
    for (const over of ["pointerup", "pointerleave", "pointercancel", "blur"]) stop.addEventListener(over, () => this.releaseStop());
    stop.addEventListener("keydown", (event) => { if ([" ", "Enter"].includes(event.key)) { event.preventDefault(); this.holdStop(); } });
    stop.addEventListener("keyup", () => this.releaseStop());
    setInterval(() => { for (const arm of Object.values(this.#arms)) arm.draw(); }, 500);
  }

  enter(operator, setup) { this.#operator = operator; this.#setup = setup; this.#enable(); }

  rows(header, body) { this.#arms[header.arm]?.rows(header, body); }

  news(news) {
    if (this.#events.some((one) => one.id === news.id)) return;
    this.#events.unshift(news);
    this.#events.length = Math.min(this.#events.length, MOST_EVENTS);
    $("events").replaceChildren(...this.#events.map((one) => make("li", { className: one.level === "error" ? "bad" : one.level === "warning" ? "warning" : "" },
      make("time", { dateTime: one.time }, clock(one.time)), one.kind === "mark" && one.text !== "mark" ? `mark: ${one.text}` : one.text)));
  }

  show(status, liveError) {
    this.#status = status; this.#unknown = "";
    this.#possible = new Set(status.busy ? [] : status.possible);
    this.#enable();
    for (const [name, arm] of Object.entries(this.#arms)) arm.show(status.arms[name], status, liveError);
    this.#now(status);
    this.#ledger(status);
  }

  /** The state shown is old, so no command can be given. */
  stale(why) { this.#unknown = why; this.#possible = new Set(); this.#enable(); }

  key(key) {
    const button = { a: "arm", r: "record", m: "mark", s: "stop", d: "disarm" }[key];
    if (!button) return false;
    if ($(button).disabled) this.#refuse(COMMANDS[button]);
    else if (button === "stop") this.holdStop();
    else $(button).click();
    return true;
  }

  /** Explain why a key has no effect; a disabled button shows that by itself. */
  #refuse(command) {
    const { state, busy, possible } = this.#status ?? {};
    const why = this.#unknown ? `: ${this.#unknown}` : busy ? ` while the daemon is busy: ${busy}`
      : !possible.includes(command) ? ` while ${state}; possible: ${possible.join(", ")}`
        : `: ${this.#operator === null ? "the log-in is not complete yet" : "you are logged in as a viewer"}`;
    this.#refused = { command, text: `cannot ${command}${why}` };
    this.#fail(this.#refused.text);
  }

  holdStop() {
    if ($("stop").disabled || this.#hold !== null) return;
    $("stop").classList.add("holding");
    this.#hold = setTimeout(() => { this.releaseStop(); this.#do("stop"); }, HOLD_MS);
  }

  releaseStop() { clearTimeout(this.#hold); this.#hold = null; $("stop").classList.remove("holding"); }

  #enable() {
    for (const [id, command] of Object.entries(COMMANDS)) $(id).disabled = !this.#operator || !this.#possible.has(command);
    if (this.#refused && this.#operator && this.#possible.has(this.#refused.command)) {
      if ($("error").textContent === this.#refused.text) this.#fail("");
      this.#refused = null;
    }
  }

  async #do(command, body) {
    this.#fail("");
    try { await ask("POST", command, body ?? (command === "arm" ? {} : undefined)); }
    catch (error) { this.#fail(error.message); }
  }

  #record() {
    const pre = Number($("pre").value || 0), length = Number($("length").value || 0), body = {};
    if (pre > 0) body.pre_s = pre;
    if (length > 0) body.duration_s = pre + length;
    this.#do("start", body);
  }

  async #mark() {
    if ($("mark").disabled) { this.#refuse("mark"); return; }
    await this.#do("mark", { text: $("mark-text").value });
    $("mark-text").value = "";
  }

  #now(status) {
    const past = Object.values(status.run_id ? status.arms : {}).map((arm) => arm.ring.history / arm.ring.slots), facts = [];
    const history = this.#setup && past.length ? Math.min(this.#setup.history_s, Math.min(...past) * this.#setup.history_s * (4 / 3)) : null;
    facts.push(["Recording", status.recording ? `${name(status.recording.path)}, ${counted(status.recording.recorded_lines, "line")}, ${count(status.recording.committed_lines)} readable` : "–"]);
    facts.push(["Pre-trigger", history === null ? "–" : `${history.toFixed(1)} s available now`]);
    facts.push(["Trigger", status.trigger ? `${status.trigger.answers ? "answers" : `SILENT for ${duration(status.trigger.silent_s)}`}, ${counted(status.trigger.pulses, "line")}` : "–"]);
    facts.push(["Disk", status.disk_trouble ? `✗ ${status.disk_trouble}` : status.disk ? `${quantity(status.disk.free_bytes, "B")} free, full in ${duration(status.disk.seconds_to_full)}` : "–"]);
    facts.push(["Last", status.last ? `${name(status.last.path)}, ${counted(status.last.lines, "line")}, ${status.last.condition ?? "not sealed"}` : "–"]);
    if (status.light && status.light !== "rig") facts.push(["Light", `✗ stays ${status.light === "dark" ? "off" : "on"}, as for a calibration: disarm, then arm`]);
    if (status.waiting) facts.push(["Waiting", status.waiting]);
    fill($("now"), JSON.stringify(facts), () => facts.flatMap(([term, text]) => [make("dt", {}, term), make("dd", {}, text)]));
  }

  #ledger(status) {
    const arms = Object.entries(status.arms), causes = [...new Set(arms.flatMap(([, arm]) => Object.keys(arm.lost)))];
    const rows = [["issued", "issued"], ["preroll", "pre-roll"], ["stored", "stored"], ["discarded", "not recorded"], ["waiting", "in the ring"], ["pending", "in transit"]];
    const cells = [...rows.map(([key, text]) => [text, ...arms.map(([, arm]) => (arm.ledger ? count(arm.ledger[key]) : "–")), false]),
      ...causes.map((cause) => [`lost: ${cause.replaceAll("_", " ")}`, ...arms.map(([, arm]) => count(arm.lost[cause] ?? 0)), arms.some(([, arm]) => arm.lost[cause])])];
    fill($("ledger"), JSON.stringify(cells), () => arms.length
      ? [make("tr", {}, make("th", { scope: "col" }, "lines"), ...arms.map(([arm]) => make("th", { className: "number", scope: "col" }, arm.toUpperCase()))),
        ...cells.map(([text, ...values]) => make("tr", { className: values.at(-1) ? "bad" : "" }, make("td", {}, text), ...values.slice(0, -1).map((value) => make("td", { className: "number" }, value))))]
      : [make("tr", {}, make("td", {}, "Nothing has been armed yet."))]);
  }
}

const name = (path) => path.split("/").at(-1);

class Arm {
  #fall; #histogram; #newest = make("span", {}, "now"); #numbers = make("span"); #level = make("span"); #none; #canvas; #run = null; #configured = 0;

  constructor(arm) {
    this.arm = arm;
    this.#canvas = make("canvas", { role: "img", "aria-label": `Camera ${arm.toUpperCase()}: no picture` });
    const bars = make("canvas", { className: "histogram", role: "img", "aria-label": `Camera ${arm.toUpperCase()}: histogram` });
    this.#none = make("p", { className: "none" }, "No lines: arm the instrument.");
    this.#fall = new Waterfall(this.#canvas);
    this.#histogram = new Histogram(bars);
    this.bars = bars;
    this.element = make("article", { className: "arm", "aria-label": `Camera ${arm.toUpperCase()}` },
      make("header", {}, make("b", {}, `Camera ${arm.toUpperCase()}`), this.#numbers, this.#level),
      make("div", { className: "fall" }, make("div", { className: "scale", "aria-hidden": "true" }, make("span", {}, `−${SHOWN_S} s`), this.#newest), this.#canvas, this.#none), bars,
      make("div", { className: "axis", "aria-hidden": "true" }, make("span", {}, "black"), make("span", {}, "pixels by value, logarithmic"), make("span", {}, "white")));
    this.#fall.clear();
  }

  rows(header, body) { this.#fall.add(header, body); this.#histogram.add(header); this.#none.hidden = true; }

  show(arm, status, liveError) {
    if (status.run_id !== this.#run) { this.#run = status.run_id; if (status.run_id) { this.#fall.clear(); this.#histogram.clear(); } }
    // The last picture must not stand there as if it were the newest.
    if (liveError) this.#fall.clear();
    this.#none.hidden = Boolean(status.run_id) && !this.#fall.isEmpty;
    this.#none.textContent = liveError ? `No picture: ${liveError}` : noLines(status, this.#fall.isEmpty);
    this.element.classList.toggle("past", !status.run_id && !this.#fall.isEmpty);
    this.#newest.textContent = status.run_id ? "now" : "end";
    if (!arm) { this.#numbers.textContent = ""; return; }
    const verdict = arm.check ? `code ${arm.check.verdict.replaceAll("_", " ")}${arm.check.shift ? ` ${arm.check.shift > 0 ? "+" : ""}${arm.check.shift}` : ""}` : "code not checked";
    const text = `${quantity(arm.rate_hz, "lines/s")} · ring ${percent(arm.ring.fill / arm.ring.slots)} · ${verdict}`;
    this.#numbers.textContent = text;
    this.#numbers.className = arm.check && !["verified", "unknown"].includes(arm.check.verdict) ? "bad" : "";
    this.saturated = arm.saturated_part;
  }

  /** Called twice a second, since numbers that change faster cannot be read. */
  draw() {
    const { median, saturated } = this.#histogram.draw();
    if (median === null) { this.#level.textContent = ""; return; }
    const part = Math.max(saturated, 0);
    this.#level.textContent = `level ${percent(median)} · saturated ${percent(part)} of pixels, ${percent(this.saturated ?? 0)} of lines`;
    this.#level.className = (this.saturated ?? 0) > 0.05 ? "bad" : (this.saturated ?? 0) > 0.001 ? "warning" : "";
    this.#canvas.setAttribute("aria-label", `Camera ${this.arm.toUpperCase()}, the last ${SHOWN_S} seconds: ${this.#numbers.textContent}; ${this.#level.textContent}`);
    this.bars.setAttribute("aria-label", `Camera ${this.arm.toUpperCase()}, histogram: ${this.#level.textContent}`);
  }
}
