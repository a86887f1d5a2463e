// The steps of a calibration, each with its preparation, a button, and its findings with their uncertainties.

import { ask } from "./link.js";
import { $, count, counted, day, fill, make } from "./words.js";

const REFRESH_MS = 1000;
const TITLES = { delay: "Delay", dark: "Dark", linearity: "Linearity", flat: "Flat", target: "Target", psf: "Blur", veil: "Veil" };
/** States of the daemon in which a step can use the instrument. */
const FREE = ["idle", "armed"];

export class Calibrate {
  #fail; #operator = null; #status = null; #unknown = ""; #cards = new Map(); #job = null; #timer = null; #steps = []; #shownError = "";

  constructor(fail) { this.#fail = fail; }

  enter(operator) { this.#operator = operator; this.#enable(); }

  show(status) { this.#status = status; this.#unknown = ""; this.#enable(); }

  /** The state shown is old, so no step can be started. */
  stale(why) { this.#unknown = why; this.#enable(); }

  /** The screen is opened: read the calibration, and follow a running step. */
  async open() {
    clearTimeout(this.#timer);
    if ($("aim").hidden) return;
    try {
      this.#build(await ask("GET", "calibration"));
      await this.#follow();
      if (this.#shownError && $("error").textContent === this.#shownError) this.#fail("");
      this.#shownError = "";
    } catch (error) { this.#again(error); }
  }

  /** Show a failure and try again until it works, since the page's server may just be starting. */
  #again(error) {
    if ($("aim").hidden) return;
    this.#fail(this.#shownError = error.message);
    this.#timer = setTimeout(() => this.open(), REFRESH_MS);
  }

  async #follow() {
    clearTimeout(this.#timer);
    if ($("aim").hidden) return;
    const [latest] = (await ask("GET", "jobs")).filter((job) => job.kind === "calibrate");
    const was = this.#job, ended = was?.state === "running" && (latest?.id !== was.id || latest.state !== "running");
    this.#job = latest ?? (ended ? { ...was, state: "failed", text: "the page's server was restarted, which ended the step" } : was);
    if (ended) this.#build(await ask("GET", "calibration"));
    this.#showJob();
    if (this.#job?.state === "running") this.#timer = setTimeout(() => this.#follow().catch((error) => this.#again(error)), REFRESH_MS);
  }

  #build(facts) {
    this.#steps = facts.steps;
    $("calibration-place").textContent = facts.error ?? `${facts.path}. ${facts.named ? "The rig names it: every recording gets a copy." : `Recordings will get a copy once the rig file sets calibration = "${facts.path}".`}`;
    $("calibration-place").className = facts.error ? "bad" : "hint";
    if (!this.#cards.size) {
      for (const step of facts.steps) this.#cards.set(step.name, new Card(step, (asked) => this.#begin(step.name, asked), () => this.#cancel(), (finding) => this.#ask(step.name, finding)));
      $("steps").replaceChildren(...[...this.#cards.values()].map((card) => card.element));
    }
    for (const step of facts.steps) this.#cards.get(step.name).found(step.found);
    this.#enable();
  }

  async #begin(step, asked) {
    this.#fail("");
    try { this.#job = await ask("POST", "calibration", { step, ...asked }); this.#showJob(); await this.#follow(); }
    catch (error) { this.#fail(error.message); }
  }

  /** Ask whether a finding is to be forgotten, with all that depend on it. */
  #ask(step, finding) {
    const steps = [finding.name, ...finding.also], dialog = $("forget");
    $("forget-title").textContent = `Forget ${steps.join(", ")}?`;
    $("forget-text").textContent = `Reconstructions will no longer correct ${steps.length > 1 ? "them" : "it"}. Recordings keep the copies that they carry.${finding.also.length ? ` ${counted(finding.also.length, "other step")} must go as well:` : ""}`;
    $("forget-why").replaceChildren(...finding.why.map((why) => make("li", {}, why)));
    dialog.returnValue = "";
    dialog.onclose = () => { if (dialog.returnValue === "forget") this.#forget(step, steps); };
    dialog.showModal();
  }

  async #forget(step, steps) {
    this.#fail("");
    try { this.#build(await ask("POST", "calibration/forget", { steps })); this.#showJob(); $(`begin-${step}`).focus(); }
    catch (error) { this.#fail(error.message); }
  }

  async #cancel() {
    try { await ask("DELETE", `jobs/${this.#job.id}`); await this.#follow(); }
    catch (error) { this.#fail(error.message); }
  }

  #showJob() {
    for (const [name, card] of this.#cards) card.follow(this.#job?.step === name ? this.#job : null);
    this.#enable();
  }

  /** Return why a step cannot be started now; empty if it can. */
  #why(step) {
    if (this.#unknown) return this.#unknown;
    if (this.#operator === null || !this.#status) return "The page is still connecting to the instrument.";
    if (!this.#operator) return "Only an operator can do this; you are logged in as a viewer.";
    if (this.#job?.state === "running") return this.#job.step === step.name ? "" : `The step ${TITLES[this.#job.step]} is running.`;
    if (!FREE.includes(this.#status.state)) return this.#status.state === "faulted" ? "The instrument has a fault: disarm it first." : "The instrument is recording.";
    const before = this.#steps.find((one) => one.name === step.after);
    return before && !before.found.length ? `The step ${TITLES[step.after]} must be done first.` : "";
  }

  #enable() {
    const free = this.#operator && !this.#unknown && this.#job?.state !== "running";
    for (const step of this.#steps) this.#cards.get(step.name).enable(this.#why(step), this.#operator, free);
  }
}

class Card {
  #state = make("span"); #text = make("p", { role: "status" }); #bar = make("progress", { hidden: true }); #found = make("div");
  #lines; #black = make("input", { type: "checkbox" }); #begin; #cancel; #why = make("p", { className: "hint" }); #running = false; #done = false; #free = false; #forget;

  constructor(step, begin, cancel, forget) {
    this.#forget = forget;
    const title = TITLES[step.name] ?? step.name;
    this.#lines = make("input", { type: "number", id: `lines-${step.name}`, min: step.least_lines, max: 2 ** 20, value: step.lines ?? "", placeholder: step.lines ? String(step.lines) : "automatic", className: "long", inputMode: "numeric" });
    this.#begin = make("button", { className: "primary", id: `begin-${step.name}`, onclick: () => this.#ask(begin) }, `Measure ${title.toLowerCase()}`);
    this.#cancel = make("button", { id: `cancel-${step.name}`, hidden: true, onclick: cancel, "aria-label": `Cancel ${title.toLowerCase()}` }, "Cancel");
    this.#bar.setAttribute("aria-label", `Progress of ${title.toLowerCase()}`);
    this.#black.id = `black-${step.name}`;
    this.#why.id = `why-${step.name}`;
    this.#begin.setAttribute("aria-describedby", this.#why.id);
    this.element = make("li", { id: `step-${step.name}` }, make("h3", {}, title, this.#state), make("p", {}, step.prepare), step.black ? make("label", {}, this.#black, " ", step.black) : null,
      make("div", { className: "fields" }, make("label", {}, "Lines ", this.#lines), this.#begin, this.#cancel), this.#why, this.#bar, this.#text, this.#found);
  }

  #ask(begin) {
    if (!this.#lines.reportValidity()) return;
    begin({ ...(this.#lines.value === "" ? {} : { lines: Number(this.#lines.value) }), ...(this.#black.checked ? { black: true } : {}) });
  }

  /** `free`: findings may be forgotten now. */
  enable(why, operator, free) {
    this.#free = free;
    for (const button of this.#found.querySelectorAll("button")) button.disabled = !free;
    this.#begin.disabled = Boolean(why) || this.#running;
    this.#cancel.disabled = !operator;
    if (this.#why.textContent !== why) this.#why.textContent = why;
    this.#why.hidden = !why;
  }

  follow(job) {
    const running = job?.state === "running", handed = this.#running !== running;
    const held = [this.#begin, this.#cancel].includes(document.activeElement);
    this.#running = running;
    this.#cancel.hidden = !running;
    this.#begin.disabled = running;
    if (handed && held) (running ? this.#cancel : this.#begin).focus();
    this.#bar.hidden = !running;
    if (running && job.total) { this.#bar.max = job.total; this.#bar.value = job.done; } else this.#bar.removeAttribute("value");
    const text = { running: job?.text, failed: `Failed: ${job?.text}.`, stopped: `Cancelled: ${job?.text}.`, done: this.#done ? "Done." : "" }[job?.state] ?? "";
    if (this.#text.textContent !== text) this.#text.textContent = text;
    this.#text.className = job?.state === "failed" ? "bad" : "";
  }

  found(found) {
    const latest = found.map((one) => one.made).sort().at(-1);
    this.#done = Boolean(latest);
    this.#state.textContent = latest ? `✓ ${day(Date.parse(latest) * 1e6)}` : "not done yet";
    this.#state.className = latest ? "good" : "unknown";
    fill(this.#found, JSON.stringify(found), () => found.map((one) => make("div", {}, found.length > 1 ? make("h4", {}, one.name) : null,
      make("dl", {}, ...[["lines", count(one.lines)], ...Object.entries(one.facts)].flatMap(([what, text]) => [make("dt", {}, what), make("dd", {}, text)])),
      ...one.warnings.map((text) => make("p", { className: "warning" }, `! ${text}`)),
      make("button", { disabled: !this.#free, onclick: () => this.#forget(one) }, `Forget ${one.name}…`))));
  }
}
