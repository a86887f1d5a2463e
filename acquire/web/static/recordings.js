// Recordings: a list with pictures, and one in detail with its time line, to cut, hold or reconstruct.

import { ask } from "./link.js";
import { Player } from "./player.js";
import { $, count, counted, day, duration, fill, make, quantity } from "./words.js";

const REFRESH_MS = 3000;
/** The server lists only the newest (`archive.MOST_LISTED`). */
const MOST_LISTED = 500;

export class Recordings {
  #fail; #operator = false; #chosen = null; #detail = null; #from = 0; #lines = 0; #player; #timer = null; #refreshing = false; #shownError = "";

  constructor(fail) { this.#fail = fail; this.#player = new Player(fail); }

  enter(operator) { this.#operator = operator; }

  show() { this.#refresh(); clearInterval(this.#timer); this.#timer = setInterval(() => { if ($("recordings").hidden) clearInterval(this.#timer); else this.#refresh(); }, REFRESH_MS); }

  key(key) { return this.#player.key(key); }

  /** One refresh at a time, so that they do not pile up on a slow disk. A failure is shown until one succeeds. */
  async #refresh() {
    if (this.#refreshing) return;
    this.#refreshing = true;
    try {
      const [recordings, jobs, videos] = await Promise.all([ask("GET", "recordings"), ask("GET", "jobs"), ask("GET", "videos")]);
      this.#list(recordings); this.#jobs(jobs); this.#videos(videos);
      if (this.#shownError && $("error").textContent === this.#shownError) this.#fail("");
      this.#shownError = "";
    } catch (error) { this.#fail(this.#shownError = error.message); }
    finally { this.#refreshing = false; }
  }

  #list(recordings) {
    const more = recordings.length < MOST_LISTED ? [] : [make("li", { className: "hint" }, `The newest ${MOST_LISTED} are shown; acquire ls lists all.`)];
    fill($("recording-list"), JSON.stringify([recordings, this.#chosen]), () => recordings.length ? [...recordings.map((one) => {
      const lost = Object.values(one.lost_lines ?? {}).reduce((sum, n) => sum + n, 0), state = one.error ? "cannot be read" : one.condition ?? one.state;
      return make("li", {}, make("button", { id: `recording-${one.name}`, "aria-pressed": String(one.name === this.#chosen), onclick: () => this.#choose(one.name) },
        one.error ? make("span", { className: "blank", "aria-hidden": "true" }) : make("img", { src: `/api/recordings/${encodeURIComponent(one.name)}/picture?${one.lines}`, alt: "", loading: "lazy" }),
        make("span", {}, make("b", {}, one.name),
          make("small", { className: one.error || one.damage || lost || one.tainted_by.length || one.incomplete.length ? "bad" : "" }, `${state}${lost ? `, ${counted(lost, "line")} lost` : ""}${one.incomplete.length ? ", its lists are incomplete" : ""}${one.held ? ", held" : ""}`),
          make("small", {}, one.error ?? `${counted(one.lines, "line")}, ${duration(one.duration_s)}, ${quantity(one.bytes, "B")}`),
          make("small", {}, [one.start_ns ? day(one.start_ns) : "", one.uploaded ? `copied to ${one.uploaded}` : ""].filter(Boolean).join("; ")))));
    }), ...more] : [make("li", {}, "No recordings yet.")]);
  }

  async #choose(name) {
    this.#chosen = name; this.#fail("");
    let detail;
    try { detail = await ask("GET", `recordings/${encodeURIComponent(name)}`); }
    catch (error) { this.#fail(error.message); return; }
    if (this.#chosen !== name) return;  // another recording was chosen in the meantime
    this.#detail = detail;
    this.#from = this.#detail.first_line;
    this.#lines = Math.min(this.#detail.lines, 512);
    this.#build();
    this.#refresh();
  }

  #build() {
    const one = this.#detail, off = !this.#operator;
    const first = make("input", { id: "first-line", className: "long", type: "number", min: one.first_line, value: this.#from }), lines = make("input", { id: "line-count", type: "number", min: 1, max: one.lines, value: this.#lines });
    const side = make("input", { id: "voxel-side", type: "number", min: 1, max: 64, value: 3 }), time = make("input", { id: "voxel-time", type: "number", min: 1, max: 4096, value: 1 });
    const preset = make("select", { id: "preset" }, ...["fast", "balanced", "best"].map((text) => make("option", { selected: text === "balanced" }, text)));
    const strip = this.#strip(one, first, lines);
    const job = (kind) => () => this.#job({ kind, recording: one.name, first_line: Number(first.value), lines: Number(lines.value), spatial_merge: Number(side.value), temporal_merge: Number(time.value), preset: preset.value });
    $("detail").replaceChildren(make("h2", {}, one.name), make("dl", {},
      ...[["Lines", `${count(one.lines)}, from ${count(one.first_line)} on, at ${quantity(one.line_rate_hz, "lines/s")}`], ["Condition", `${one.condition ?? one.state}${one.end_reason ? `, ${one.end_reason}` : ""}`], ["Lost", one.lost_lines === null ? "unknown" : Object.entries(one.lost_lines).map(([arm, n]) => `${arm.toUpperCase()} ${count(n)}`).join(", ")], ["Tainted by", one.tainted_by.join("; ") || "nothing"], ["Damage", one.damage ?? "none that shows"], ...(one.incomplete.length ? [["Incomplete", one.incomplete.join("; ")]] : [])]
        .flatMap(([term, text]) => [make("dt", {}, term), make("dd", {}, text)])),
      make("p", { className: "hint" }, "Drag over the time line to select a range, or click an event."), strip.element,
      make("ul", { className: "fields", "aria-label": "Events" }, ...one.event_list.slice(-12).map((event) => make("li", {}, make("button", { onclick: () => strip.choose(Math.max(one.first_line, event.line - 128), 256) }, `${event.kind}${event.text ? `: ${event.text}` : ""}`)))),
      make("div", { className: "fields" }, make("label", {}, "From line ", first), make("label", {}, "Lines ", lines), make("label", {}, "Voxel side ", side), make("label", {}, "Sub-steps ", time), make("label", {}, "Preset ", preset)),
      make("div", { className: "fields" }, make("button", { className: "primary", id: "reconstruct", disabled: off, onclick: job("reconstruct") }, "Reconstruct"), make("button", { id: "preview", disabled: off, onclick: job("preview") }, "Preview"),
        make("button", { id: "cut", disabled: off, onclick: job("cut") }, "Cut"), make("button", { id: "hold", disabled: off, onclick: () => this.#hold(one.name, Number(first.value), Number(lines.value)) }, "Hold")));
    strip.draw();
  }

  #strip(one, first, lines) {
    const canvas = make("canvas", { role: "img", "aria-label": `${counted(one.event_list.length, "event")}, ${counted(one.gap_list.length, "gap")}, ${counted(one.hold_list.length, "held range")}` }), element = make("div", { className: "strip" }, canvas);
    const draw = () => {
      const width = (canvas.width = element.clientWidth || 600), height = (canvas.height = element.clientHeight || 88), context = canvas.getContext("2d");
      const x = (line) => ((line - one.first_line) / Math.max(1, one.lines)) * width;
      context.fillStyle = "#10141a"; context.fillRect(0, 0, width, height);
      context.fillStyle = "#2f6fd077"; context.fillRect(x(Number(first.value)), 0, Math.max(2, x(Number(first.value) + Number(lines.value)) - x(Number(first.value))), height);
      context.fillStyle = "#3fa36a"; for (const held of one.hold_list) context.fillRect(x(held.first_line), height - 8, Math.max(2, x(held.first_line + held.count) - x(held.first_line)), 8);
      context.fillStyle = "#e62ebe"; for (const gap of one.gap_list) context.fillRect(x(gap.first_line), gap.arm === "a" ? 8 : 24, Math.max(2, x(gap.first_line + gap.count) - x(gap.first_line)), 14);
      context.fillStyle = "#ffd166"; for (const event of one.event_list) { context.beginPath(); context.arc(Math.min(width - 5, Math.max(5, x(event.line))), height / 2 + 8, 5, 0, 7); context.fill(); }
    };
    const choose = (from, n) => { first.value = Math.round(from); lines.value = Math.max(1, Math.round(Math.min(n, one.first_line + one.lines - from))); draw(); };
    const lineAt = (event) => one.first_line + Math.min(1, Math.max(0, event.offsetX / element.clientWidth)) * one.lines;
    let begun = null;
    element.addEventListener("pointerdown", (event) => { begun = lineAt(event); element.setPointerCapture(event.pointerId); });
    element.addEventListener("pointermove", (event) => { if (begun !== null) choose(Math.min(begun, lineAt(event)), Math.abs(lineAt(event) - begun)); });
    element.addEventListener("pointerup", () => { begun = null; });
    for (const input of [first, lines]) input.addEventListener("input", draw);
    new ResizeObserver(draw).observe(element);
    return { element, draw, choose };
  }

  async #job(request) { this.#fail(""); try { await ask("POST", "jobs", request); this.#refresh(); } catch (error) { this.#fail(error.message); } }

  async #hold(name, first_line, lines) {
    this.#fail("");
    try { await ask("POST", `recordings/${encodeURIComponent(name)}/hold`, { first_line, lines, why: "held on the page" }); await this.#choose(name); }
    catch (error) { this.#fail(error.message); }
  }

  #jobs(jobs) {
    fill($("jobs"), JSON.stringify([jobs, this.#operator]), () => jobs.length ? jobs.map((job) => make("li", {},
      make("b", { className: job.state === "failed" ? "bad" : job.state === "done" ? "good" : "" }, job.state), ` ${job.step ? `${job.kind} ${job.step}` : `${job.kind} of ${job.recording}, ${counted(job.lines, "line")} from ${count(job.first_line)}`}`, job.text ? make("small", {}, job.text) : null,
      job.state === "running" && job.total ? make("progress", { max: job.total, value: job.done, "aria-label": `Progress of job ${job.id}` }) : null,
      job.result?.endsWith(".npz") ? make("a", { href: `/api/cuts/${encodeURIComponent(job.result)}`, download: job.result }, job.result) : null,
      ["waiting", "running"].includes(job.state) ? make("button", { id: `stop-${job.id}`, disabled: !this.#operator, "aria-label": `Stop job ${job.id}`, onclick: () => ask("DELETE", `jobs/${job.id}`).then(() => this.#refresh(), (error) => this.#fail(error.message)) }, "Stop") : null)) : [make("li", {}, "None.")]);
  }

  #videos(videos) {
    fill($("videos"), JSON.stringify(videos), () => videos.length ? videos.map((video) => make("li", {},
      make("button", { id: `video-${video.name}`, onclick: () => this.#player.open(video.name), disabled: Boolean(video.error) }, video.name), video.error ?? `${counted(video.frames, "frame")} of ${video.columns} × ${video.rows}, ${quantity(video.interval_ns / 1e9, "s")} apart`)) : [make("li", {}, "None yet: choose a recording and reconstruct a stretch.")]);
  }
}
