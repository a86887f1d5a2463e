// The latest seconds of one arm: newest at the bottom, lost lines hatched, saturated pixels coloured.

export const SHOWN_S = 5;
const LOST = 1, UNSEEN = 2;

/** Width of the strip that marks the kind of each row, in columns. */
export const marginOf = (columns) => Math.max(1, Math.round(columns / 100));

export class Waterfall {
  #context; #columns = 0; #next = null; #merge = null; #height;

  constructor(canvas, height = 320) {
    this.canvas = canvas;
    this.#height = height;
    this.#context = canvas.getContext("2d", { alpha: false, willReadFrequently: false });
  }

  get isEmpty() { return this.#columns === 0; }

  clear() { this.#columns = 0; this.#next = null; this.canvas.width = 1; this.canvas.height = 1; }

  /** Add the rows of a message: `header.rows` × `header.columns`, first kinds, then low, then high values. */
  add(header, body) {
    const { rows, columns, first } = header;
    if (columns !== this.#columns) this.#begin(columns);
    const perPixel = Math.max(1, Math.round(SHOWN_S / header.row_s / this.#height));
    const high = body.subarray(rows + rows * columns);
    const unseen = this.#next === null ? 0 : Math.min(first - this.#next, this.#height * perPixel);
    for (let row = 0; row < unseen; row++) this.#take(null, UNSEEN, perPixel);
    for (let row = 0; row < rows; row++) this.#take(high.subarray(row * columns, (row + 1) * columns), body[row], perPixel);
    this.#next = first + rows;
    this.#draw();
  }

  #begin(columns) {
    this.#columns = columns;
    this.margin = marginOf(columns);
    this.canvas.width = columns + this.margin; this.canvas.height = this.#height;
    this.#merge = { values: new Uint8Array(columns), kind: 0, count: 0, seen: false };
    this.ready = [];
  }

  #take(values, kind, perPixel) {
    const merge = this.#merge;
    merge.kind = Math.max(merge.kind, kind === UNSEEN && merge.seen ? 0 : kind);
    if (values && kind !== UNSEEN) { merge.seen = true; for (let i = 0; i < values.length; i++) if (values[i] > merge.values[i]) merge.values[i] = values[i]; }
    if (++merge.count < perPixel) return;
    this.ready.push(merge);
    this.#merge = { values: new Uint8Array(this.#columns), kind: 0, count: 0, seen: false };
  }

  #draw() {
    const rows = this.ready.splice(0).slice(-this.#height), count = rows.length;
    if (!count) return;
    const width = this.canvas.width, margin = this.margin, image = this.#context.createImageData(width, count), pixels = image.data;
    rows.forEach((row, y) => {
      for (let x = 0; x < width; x++) {
        const at = 4 * (y * width + x), hatch = (x + y) % 6 < 3;
        let r, g, b;
        if (x < margin) [r, g, b] = row.kind === LOST ? [230, 40, 190] : row.kind === UNSEEN ? [110, 110, 110] : [40, 110, 70];
        else if (row.kind === LOST && !row.seen) [r, g, b] = hatch ? [200, 0, 160] : [40, 0, 32];
        else if (!row.seen) [r, g, b] = hatch ? [90, 90, 90] : [30, 30, 30];
        else { const v = row.values[x - margin]; [r, g, b] = v >= 255 ? [255, 90, 40] : [v, v, v]; }
        pixels[at] = r; pixels[at + 1] = g; pixels[at + 2] = b; pixels[at + 3] = 255;
      }
    });
    this.#context.drawImage(this.canvas, 0, -count);
    this.#context.putImageData(image, 0, this.canvas.height - count);
  }
}

/** Histogram of the last second: logarithmic bars, with the saturated one coloured. */
export class Histogram {
  #sums = []; #canvas;

  constructor(canvas) { this.#canvas = canvas; }

  add(header) {
    this.#sums.push([header.histogram, header.saturated]);
    if (this.#sums.length > 20) this.#sums.shift();
  }

  clear() { this.#sums = []; this.draw(); }

  /** Draw, and return the median as a fraction of the range and the fraction of saturated pixels. */
  draw() {
    const bins = new Float64Array(64);
    let saturated = 0, total = 0;
    for (const [counts, white] of this.#sums) { counts.forEach((n, i) => { bins[i] += n; total += n; }); saturated += white; }
    const canvas = this.#canvas, width = (canvas.width = canvas.clientWidth || 300), height = (canvas.height = canvas.clientHeight || 70);
    const context = canvas.getContext("2d"), style = getComputedStyle(canvas), top = Math.log1p(Math.max(1, ...bins)), step = width / bins.length;
    context.fillStyle = style.color;
    bins.forEach((n, i) => {
      const tall = n ? Math.max(1, (height - 4) * Math.log1p(n) / top) : 0;
      if (i === bins.length - 1) context.fillStyle = saturated ? "#ff5a28" : style.color;
      context.fillRect(i * step, height - tall, Math.max(1, step - 1), tall);
    });
    let half = 0, median = 0;
    while (median < 63 && (half += bins[median]) < total / 2) median++;
    return { median: total ? median / 63 : null, saturated: total ? saturated / total : 0 };
  }
}
