// A video player: frames are read in batches of 8-bit frames and drawn to a canvas; untrusted frames are marked.

import { ask } from "./link.js";
import { $, count, make, quantity } from "./words.js";

const MOST_FRAMES = 64, MOST_BATCHES = 8;
/** The most that an answer holds (`archive.MOST_FRAME_BYTES`): of large frames it has fewer than asked for. */
const MOST_BYTES = 4 * 2 ** 20;

export class Player {
  #fail; #asked = 0; #video = null; #frame = 0; #batches = new Map(); #timer = null; #batch = 1; #canvas; #slider; #text; #play; #speed;

  constructor(fail) { this.#fail = fail; }

  async open(name) {
    this.#stop(); this.#batches.clear(); this.#fail("");
    const asked = ++this.#asked;
    let video;
    try { video = await ask("GET", `videos/${encodeURIComponent(name)}`); }
    catch (error) { this.#fail(error.message); return; }
    if (asked !== this.#asked) return;  // another video was opened in the meantime
    this.#batches.clear();
    this.#video = video;
    this.#batch = Math.max(1, Math.min(MOST_FRAMES, Math.floor(MOST_BYTES / (video.rows * video.columns))));
    this.#canvas = make("canvas", { width: video.columns, height: video.rows, role: "img", "aria-label": name });
    this.#slider = make("input", { type: "range", min: 0, max: video.frames - 1, value: 0, "aria-label": "Frame", oninput: () => this.#show(Number(this.#slider.value)) });
    this.#text = make("p", { id: "frame-text" });
    const missing = video.missing.map(([first, end]) => end - first === 1 ? `${end}` : `${first + 1} to ${end}`).join(", ");
    this.#play = make("button", { id: "play", onclick: () => this.toggle() }, "Play");
    this.#speed = make("select", { "aria-label": "Frames per second" }, ...[5, 12, 25, 50].map((fps) => make("option", { selected: fps === 25, value: fps }, `${fps} frames/s`)));
    $("player").replaceChildren(make("h2", {}, name), missing ? make("p", { className: "warning" }, `Files of this video are missing: frames ${missing} cannot be shown.`) : "", this.#canvas, this.#slider, this.#text, make("div", { className: "fields" },
      make("button", { "aria-label": "Previous frame", id: "back", onclick: () => this.step(-1) }, "◀"), this.#play, make("button", { "aria-label": "Next frame", id: "on", onclick: () => this.step(1) }, "▶"), this.#speed));
    await this.#show(0);
    this.#canvas.scrollIntoView({ block: "nearest" });
  }

  key(key) {
    if (!this.#video) return false;
    if (key === " ") { this.toggle(); return true; }
    if (key === "ArrowLeft" || key === "ArrowRight") { this.step(key === "ArrowLeft" ? -1 : 1); return true; }
    return false;
  }

  step(frames) { this.#stop(); return this.#show((this.#frame + frames + this.#video.frames) % this.#video.frames); }

  toggle() {
    if (this.#timer) { this.#stop(); return; }
    this.#play.textContent = "Pause";
    const next = async () => {
      await this.#show((this.#frame + 1) % this.#video.frames);
      if (this.#timer) this.#timer = setTimeout(next, 1000 / Number(this.#speed.value));
    };
    this.#timer = setTimeout(next, 0);
  }

  #stop() { clearTimeout(this.#timer); this.#timer = null; if (this.#play) this.#play.textContent = "Play"; }

  async #show(frame) {
    const video = this.#video, size = video.rows * video.columns, batch = Math.floor(frame / this.#batch);
    try { await this.#load(video, batch); } catch (error) { this.#stop(); this.#fail(error.message); return; }
    if (video !== this.#video || !this.#batches.has(batch)) return;
    const { frames, lost } = this.#batches.get(batch), unreadable = lost.some(([first, last]) => first <= frame && frame <= last);
    const bytes = frames.subarray((frame - batch * this.#batch) * size, (frame - batch * this.#batch + 1) * size);
    const image = new ImageData(video.columns, video.rows);
    for (let i = 0; i < size; i++) image.data.set([bytes[i], bytes[i], bytes[i], 255], 4 * i);
    this.#canvas.getContext("2d").putImageData(image, 0, 0);
    this.#frame = frame;
    this.#slider.value = frame;
    const trusted = !video.trusted || (frame >= video.trusted[0] && frame < video.trusted[1]);
    const doubt = unreadable ? " – it cannot be read, and is shown black" : trusted ? "" : " – not trusted, because it was not sampled in full";
    this.#text.textContent = `Frame ${count(frame + 1)} of ${count(video.frames)}, ${quantity((frame * video.interval_ns) / 1e9, "s")} after the first${doubt}`;
    this.#text.className = doubt ? "warning" : "";
  }

  async #load(video, batch) {
    if (this.#batches.has(batch)) return;
    const answer = await fetch(`/api/videos/${encodeURIComponent(video.name)}/frames?first=${batch * this.#batch}&count=${this.#batch}`);
    // 424: none of these frames can be read; others of the video may be.
    if (!answer.ok && answer.status !== 424) throw new Error((await answer.json()).message);
    const size = video.rows * video.columns, unreadable = answer.ok ? answer.headers.get("X-Unreadable-Frames") : `${batch * this.#batch}-${(batch + 1) * this.#batch - 1}`;
    const frames = answer.ok ? new Uint8Array(await answer.arrayBuffer()) : new Uint8Array(this.#batch * size);
    if (video !== this.#video) return;  // the frames belong to another video
    this.#batches.set(batch, { frames, lost: unreadable ? unreadable.split(",").map((one) => one.split("-").map(Number)) : [] });
    while (this.#batches.size > MOST_BATCHES) this.#batches.delete(this.#batches.keys().next().value);
  }
}
