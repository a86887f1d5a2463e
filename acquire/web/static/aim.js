// Alignment of a new instrument: one large camera with its sharpness, brightness and light profile.

import { Waterfall, marginOf } from "./waterfall.js";
import { $, make, noLines, percent } from "./words.js";

export class Aim {
  #fall; #none = make("p", { className: "none" }); #run = null; #peak = 0; #smooth = null; #shown = new Float64Array(1); #profile; #focus = make("output"); #best = make("output"); #white = make("output");

  constructor() {
    const canvas = make("canvas", { role: "img", "aria-label": "The selected camera" });
    this.#profile = make("canvas", { className: "histogram profile", role: "img", "aria-label": "Brightest value of each pixel" });
    this.#fall = new Waterfall(canvas, 480);
    $("aim-view").replaceChildren(make("div", { className: "fall" }, make("div", { className: "scale", "aria-hidden": "true" }, make("span", {}, "−5 s"), make("span", {}, "now")), canvas, this.#none),
      make("div", { className: "chart" }, make("div", { className: "scale", "aria-hidden": "true" }, make("span", {}, "100\u202f%"), make("span", {}, "0")), this.#profile),
      make("div", { className: "axis chart-axis" }, make("span", {}, "first pixel"), make("span", {}, "brightest value of each pixel, in\u00a0% of white"), make("span", {}, "last pixel")));
    $("aim-numbers").replaceChildren(make("h2", {}, "Focus"), this.#focus, make("h2", {}, "Best so far"), this.#best, make("h2", {}, "Saturated pixels"), this.#white,
      make("p", { className: "hint" }, "Focus is the contrast between neighbouring pixels in percent of the light, from the brightest values. Turn the lens until it decreases again, and go back to the best."));
    this.#forget();
    $("aim-arm").addEventListener("change", () => this.#forget());
    $("aim-reset").addEventListener("click", () => this.#forget());
  }

  show(status, liveError) {
    if (status.run_id !== this.#run) { this.#run = status.run_id; if (status.run_id) this.#fall.clear(); }
    if (liveError) this.#fall.clear();
    this.#none.textContent = liveError ? `No picture: ${liveError}` : noLines(status, this.#fall.isEmpty);
    this.#none.hidden = Boolean(status.run_id) && !this.#fall.isEmpty;
    $("aim-view").classList.toggle("past", !status.run_id && !this.#fall.isEmpty);
    if (!$("aim").hidden) this.#draw();
  }

  rows(header, body) {
    if ($("aim").hidden || header.arm !== $("aim-arm").value) return;
    this.#fall.add(header, body);
    this.#none.hidden = true;
    const { rows, columns } = header, high = body.subarray(rows + rows * columns), profile = new Float64Array(columns);
    for (let row = 0; row < rows; row++) for (let x = 0; x < columns; x++) profile[x] = Math.max(profile[x], high[row * columns + x]);
    let steps = 0, light = 1e-9;
    for (let x = 1; x < columns; x++) { steps += Math.abs(profile[x] - profile[x - 1]); light += profile[x]; }
    const focus = 100 * steps / light;
    this.#smooth = this.#smooth === null ? focus : 0.85 * this.#smooth + 0.15 * focus;
    this.#peak = Math.max(this.#peak, this.#smooth);
    this.#focus.textContent = this.#smooth.toFixed(1);
    this.#best.textContent = this.#peak.toFixed(1);
    this.#white.textContent = percent(header.saturated / Math.max(1, header.histogram.reduce((sum, n) => sum + n, 0)));
    this.#shown = profile;
    this.#draw();
  }

  #forget() {
    this.#peak = 0; this.#smooth = null; this.#fall.clear(); this.#shown = new Float64Array(1);
    for (const output of [this.#focus, this.#best, this.#white]) output.textContent = "–";
  }

  /** Called with every state, too, since the theme may have changed. */
  #draw() {
    const profile = this.#shown, canvas = this.#profile, width = (canvas.width = canvas.clientWidth || 300), height = (canvas.height = canvas.clientHeight || 70), context = canvas.getContext("2d");
    context.fillStyle = getComputedStyle(canvas).color;
    // Each bar stands below its pixel in the picture, which begins with a margin.
    const margin = marginOf(profile.length), step = width / (margin + profile.length);
    profile.forEach((value, x) => context.fillRect((margin + x) * step, height - (value / 255) * height, Math.max(1, step - 1), (value / 255) * height));
  }
}
