// One stream from the page's server: state, news and rows. It is always reopened, and silence is reported.

const decoder = new TextDecoder();
export const SILENT_MS = 2000;
/** A connection that is silent for this long may be dead at the other end, and is replaced. */
const DEAD_MS = 8000;
/** The longest command seals a recording on a slow disk. */
const ANSWER_MS = 600000;
/** A hidden page polls at this interval. Browsers may limit it to once a minute, so its title may be that old. */
const HIDDEN_MS = 1500, HIDDEN_SILENT_MS = 65000;

/** Split a stream of bytes into messages: see acquire/web/frames.py. */
export class Messages {
  #rest = new Uint8Array(0);

  /** Return the messages that these bytes complete, as [header, body]. */
  take(bytes) {
    const all = new Uint8Array(this.#rest.length + bytes.length);
    all.set(this.#rest); all.set(bytes, this.#rest.length);
    const view = new DataView(all.buffer), found = [];
    let at = 0;
    while (all.length - at >= 8) {
      const head = view.getUint32(at, true), body = view.getUint32(at + 4, true);
      if (all.length - at < 8 + head + body) break;
      found.push([JSON.parse(decoder.decode(all.subarray(at + 8, at + 8 + head))), all.subarray(at + 8 + head, at + 8 + head + body)]);
      at += 8 + head + body;
    }
    this.#rest = all.slice(at);
    return found;
  }
}

export class Link extends EventTarget {
  #heard = performance.now();
  #abort = null;
  #opened = performance.now();
  glimpses = false;

  /** Follow the stream forever. A hidden page only polls, since a browser's tabs share six connections. */
  async run() {
    let shown = () => {};
    document.addEventListener("visibilitychange", () => { this.#abort?.abort(); shown(); });
    setInterval(() => this.#watch(), 250);
    for (;;) {
      try { await this.#follow(); }
      catch (error) { if (error.name !== "AbortError") console.info(`stream: ${error.message}`); }
      await new Promise((done) => { shown = done; setTimeout(done, document.visibilityState === "visible" ? 300 : HIDDEN_MS); });
    }
  }

  /** Switch coarse videos of the latest lines on or off, which reopens the stream. */
  wantGlimpses(wanted) { this.glimpses = wanted; this.#abort?.abort(); }

  async #follow() {
    this.#abort = new AbortController();
    this.#opened = performance.now();
    const followed = document.visibilityState === "visible" ? `pictures=true&glimpses=${this.glimpses}` : "once=true";
    const answer = await fetch(`/api/live?${followed}`, { signal: this.#abort.signal });
    if (answer.status === 401) { this.dispatchEvent(new Event("locked")); return; }
    if (!answer.ok) throw new Error(`The page's server answered with HTTP ${answer.status}.`);
    this.dispatchEvent(new Event("begun"));
    const messages = new Messages(), reader = answer.body.getReader();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      for (const [header, body] of messages.take(value)) {
        this.#heard = performance.now();
        this.dispatchEvent(new CustomEvent(header.type, { detail: { header, body } }));
      }
    }
  }

  #watch() {
    const now = performance.now(), silent = now - this.#heard;
    if (silent > (document.visibilityState === "visible" ? SILENT_MS : HIDDEN_SILENT_MS)) this.dispatchEvent(new CustomEvent("silent", { detail: silent / 1000 }));
    if (Math.min(silent, now - this.#opened) > DEAD_MS) this.#abort?.abort();
  }
}

/** Call the API. Throws an Error with the server's message. */
export async function ask(method, path, body) {
  const headers = { "Request-Id": `${Date.now()}-${Math.random().toString(36).slice(2)}` };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let answer;
  try { answer = await fetch(`/api/${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), signal: AbortSignal.timeout(ANSWER_MS) }); }
  catch { throw new Error("The page's server does not answer."); }
  const facts = (answer.headers.get("content-type") ?? "").includes("json") ? await answer.json() : null;
  if (answer.ok) return facts;
  const words = [facts?.message ?? `The page's server answered with HTTP ${answer.status}.`, facts?.possible && `possible: ${facts.possible}`, facts?.hint && `try: ${facts.hint}`];
  throw new Error(words.filter(Boolean).join("; "));
}
