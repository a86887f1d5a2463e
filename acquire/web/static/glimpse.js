// A coarse video of the latest lines: its frames are repeated until the next glimpse arrives.

import { $, counted, duration } from "./words.js";

const FRAME_MS = 80;
/** A glimpse is reported as late after this time, while the frames of the previous one are still repeated. */
const LATE_S = 3;

export class Glimpse {
  #header = null; #body = null; #frame = 0; #rate = []; #taken = 0; #words = ""; #timer = null;

  constructor(link) {
    $("glimpse-on").addEventListener("change", () => {
      const wanted = $("glimpse-on").checked;
      link.wantGlimpses(wanted);
      $("glimpse").hidden = !wanted;
      $("glimpse-text").textContent = wanted ? "The first picture takes a few seconds." : "";
      clearInterval(this.#timer);
      if (wanted) this.#timer = setInterval(() => this.#draw(), FRAME_MS);
      this.#header = null;
    });
    link.addEventListener("glimpse", ({ detail }) => this.#take(detail.header, detail.body));
  }

  #take(header, body) {
    if (!header.frames) return;
    this.#header = header; this.#body = body.slice(); this.#frame = 0;
    const now = performance.now();
    this.#rate = [...this.#rate, now].filter((at) => at > now - 5000);
    this.#taken = now;
    this.#words = `${header.tile ? `tile ${header.tile}, ` : ""}${header.columns} × ${header.rows} voxels, ${counted(header.frames, "frame")}, ${header.age_s.toFixed(1)} s old, ${(this.#rate.length / 5).toFixed(1)} per second`;
    $("glimpse-text").textContent = this.#words;
  }

  #draw() {
    if (!this.#header) return;
    const late_s = (performance.now() - this.#taken) / 1000;
    if (late_s > LATE_S) $("glimpse-text").textContent = `${this.#words}; no new one for ${duration(late_s)}`;
    const { rows, columns, frames } = this.#header, canvas = $("glimpse"), size = rows * columns, image = new ImageData(columns, rows);
    const bytes = this.#body.subarray(this.#frame * size, (this.#frame + 1) * size);
    for (let i = 0; i < size; i++) image.data.set([bytes[i], bytes[i], bytes[i], 255], 4 * i);
    if (canvas.width !== columns) { canvas.width = columns; canvas.height = rows; }
    canvas.getContext("2d").putImageData(image, 0, 0);
    this.#frame = (this.#frame + 1) % frames;
  }
}
