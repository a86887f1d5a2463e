// A video player: frames are read in batches of 8-bit frames and drawn to a canvas; untrusted frames are marked.

import { ask } from "./link.js";
import { $, count, make, quantity } from "./words.js";

const BATCH = 64, MOST_BATCHES = 8;

export class Player {
  #fail; #asked = 0; #video = null; #frame = 0; #batches = new Map(); #timer = null; #canvas; #slider; #text; #play; #speed;

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
    this.#canvas = make("canvas", { width: video.columns, height: video.rows, role: "img", "aria-label": name });
    this.#slider = make("input", { type: "range", min: 0, max: video.frames - 1, value: 0, "aria-label": "Frame", oninput: () => this.#show(Number(this.#slider.value)) });
    this.#text = make("p", { id: "frame-text" });
    this.#play = make("button", { id: "play", onclick: () => this.toggle() }, "Play");
    this.#speed = make("select", { "aria-label": "Frames per second" }, ...[5, 12, 25, 50].map((fps) => make("option", { selected: fps === 25, value: fps }, `${fps} frames/s`)));
    $("player").replaceChildren(make("h2", {}, name), this.#canvas, this.#slider, this.#text, make("div", { className: "fields" },
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
    const video = this.#video, size = video.rows * video.columns, batch = Math.floor(frame / BATCH);
    try { await this.#load(video, batch); } catch (error) { this.#stop(); this.#fail(error.message); return; }
    if (video !== this.#video || !this.#batches.has(batch)) return;
    const bytes = this.#batches.get(batch).subarray((frame - batch * BATCH) * size, (frame - batch * BATCH + 1) * size);
    const image = new ImageData(video.columns, video.rows);
    for (let i = 0; i < size; i++) image.data.set([bytes[i], bytes[i], bytes[i], 255], 4 * i);
    this.#canvas.getContext("2d").putImageData(image, 0, 0);
    this.#frame = frame;
    this.#slider.value = frame;
    const trusted = !video.trusted || (frame >= video.trusted[0] && frame < video.trusted[1]);
    this.#text.textContent = `Frame ${count(frame + 1)} of ${count(video.frames)}, ${quantity((frame * video.interval_ns) / 1e9, "s")} after the first${trusted ? "" : " – not trusted, because it was not sampled in full"}`;
    this.#text.className = trusted ? "" : "warning";
  }

  async #load(video, batch) {
    if (this.#batches.has(batch)) return;
    const answer = await fetch(`/api/videos/${encodeURIComponent(video.name)}/frames?first=${batch * BATCH}&count=${BATCH}`);
    if (!answer.ok) throw new Error((await answer.json()).message);
    const frames = new Uint8Array(await answer.arrayBuffer());
    if (video !== this.#video) return;  // the frames belong to another video
    this.#batches.set(batch, frames);
    while (this.#batches.size > MOST_BATCHES) this.#batches.delete(this.#batches.keys().next().value);
  }
}
