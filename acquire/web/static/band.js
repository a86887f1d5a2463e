// What is seen from three metres: a word, a colour, since when, what is left, one sentence, the lost lines.

import { $, count, duration, make } from "./words.js";

const WORDS = { idle: "idle", armed: "armed", recording: "recording", draining: "sealing", faulted: "fault" };

export class Band {
  #acknowledged = 0;
  #run = null;
  #sticky = 0;
  #last = "";

  constructor() {
    $("acknowledge").addEventListener("click", () => { this.#acknowledged = this.#sticky; this.#lost(); });
  }

  /** `nowMs`: by the clock of the instrument, since this computer's may be another. */
  show(status, health, nowMs) {
    delete document.body.dataset.stale;
    if (status.run_id && status.run_id !== this.#run) { this.#run = status.run_id; this.#acknowledged = this.#sticky = 0; }
    this.#sticky = Math.max(this.#sticky, health.lost_lines);
    const unseen = this.#sticky > this.#acknowledged;
    const state = status.state === "draining" ? "recording" : status.state === "faulted" ? "fault" : status.state;
    const calm = health.level === "good" || health.level === "idle" || (health.level === "lost" && !unseen);
    document.body.dataset.level = health.level === "fault" ? "fault" : unseen ? "lost" : calm ? state : "degraded";
    document.body.dataset.state = status.state;
    $("state").textContent = WORDS[status.state];
    $("flag").textContent = unseen ? "lines lost" : document.body.dataset.level === "degraded" ? "degraded" : "";
    $("since").textContent = status.busy ? `${status.busy} …` : `for ${duration(Math.max(0, nowMs - Date.parse(status.since)) / 1000)}`;
    $("sentence").textContent = unseen && !health.lost_lines ? `${count(this.#sticky)} lines were lost in the run before.` : health.sentence;
    [$("left-label").textContent, $("left").textContent] = left(status);
    $("rig").textContent = status.name;
    document.title = `${WORDS[status.state].toUpperCase()}${unseen ? " – LINES LOST" : ""} · ${status.name}`;
    this.#lost();
    this.#tell(`${$("state").textContent} ${$("flag").textContent}. ${$("sentence").textContent}`, document.body.dataset.level + status.state);
  }

  /** No word from the server, or from the daemon behind it. */
  stale(why) {
    document.body.dataset.stale = "";
    $("state").textContent = "no news";
    $("flag").textContent = "";
    $("since").textContent = "what is shown is old";
    $("sentence").textContent = why;
    document.title = "NO NEWS · acquire";
    this.#tell(`No news. ${why}`, "stale");
  }

  #lost() {
    $("lost").textContent = count(this.#sticky);
    $("acknowledge").hidden = this.#sticky <= this.#acknowledged;
  }

  /** Read out when the state changes, not with every number. */
  #tell(text, key) {
    if (key === this.#last) return;
    this.#last = key;
    $("told").replaceChildren(make("span", { className: "read" }, text));
    setTimeout(() => { if (this.#last === key) $("told").replaceChildren(); }, 4000);
  }
}

/** Of the recording's budget, else of the disk. */
function left(status) {
  const now = status.recording;
  if (now?.budget_lines) return ["left", `${count(Math.max(0, now.budget_lines - now.recorded_lines))} lines`];
  if (now) return ["recorded", `${count(now.recorded_lines)} lines`];
  return ["room on the disk", status.disk ? duration(status.disk.seconds_to_full) : "–"];
}
