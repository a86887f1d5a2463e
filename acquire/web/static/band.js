// The band that can be read from three metres: state, colour, duration, what is left, a sentence, lost lines.

import { $, count, counted, duration, make } from "./words.js";

const WORDS = { idle: "idle", armed: "armed", recording: "recording", draining: "sealing", faulted: "fault" };

export class Band {
  #acknowledged = 0;
  #run = null;
  #sticky = 0;
  #last = "";

  constructor() {
    $("acknowledge").addEventListener("click", () => { this.#acknowledged = this.#sticky; this.#lost(); });
  }

  /** `forS` is the time in this state, by no clock that can be set. */
  show(status, health, forS) {
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
    $("since").textContent = status.busy ? `${status.busy} …` : `for ${duration(forS)}`;
    $("sentence").textContent = unseen && !health.lost_lines ? this.#lostBefore(health) : health.sentence;
    [$("left-label").textContent, $("left").textContent] = left(status);
    $("rig").textContent = status.name;
    document.title = `${WORDS[status.state].toUpperCase()}${unseen ? " – LINES LOST" : ""} · ${status.name}`;
    this.#lost();
    this.#announce(`${$("state").textContent} ${$("flag").textContent}. ${$("sentence").textContent}`, document.body.dataset.level + status.state);
  }

  /** The server, or the daemon behind it, does not answer. */
  stale(why) {
    document.body.dataset.stale = "";
    $("state").textContent = "no contact";
    $("flag").textContent = "";
    $("since").textContent = "the values shown are old";
    $("sentence").textContent = why;
    document.title = "NO CONTACT · acquire";
    this.#announce(`No contact. ${why}`, "stale");
  }

  /** A fault has ended the run that lost the lines, and is what there is to be read first. */
  #lostBefore(health) {
    const were = `${counted(this.#sticky, "line")} ${this.#sticky === 1 ? "was" : "were"} lost`;
    return health.level === "fault" ? `${health.sentence}; before that, ${were}.` : `${were} in the previous run.`;
  }

  #lost() {
    $("lost").textContent = count(this.#sticky);
    $("acknowledge").hidden = this.#sticky <= this.#acknowledged;
  }

  /** Let screen readers announce changes of the state, but not of every number. */
  #announce(text, key) {
    if (key === this.#last) return;
    this.#last = key;
    $("told").replaceChildren(make("span", { className: "read" }, text));
    setTimeout(() => { if (this.#last === key) $("told").replaceChildren(); }, 4000);
  }
}

/** Return label and amount of what is left of the recording's budget, or else of the disk. */
function left(status) {
  const now = status.recording;
  if (now?.budget_lines) return ["left", counted(Math.max(0, now.budget_lines - now.recorded_lines), "line")];
  if (now) return ["recorded", counted(now.recorded_lines, "line")];
  return ["space on the disk", status.disk_trouble ? "unusable" : status.disk ? duration(status.disk.seconds_to_full) : "–"];
}
