// One stream from the page's server: state, news and rows. It is opened again for ever, and silence is told.

const decoder = new TextDecoder();
export const SILENT_MS = 2000;
/** A connection that has been silent for so long may be one of which only this end is left: another one is made. */
const DEAD_MS = 8000;
/** The longest command is a recording that is sealed on a slow disk. */
const ANSWER_MS = 600000;
/** A hidden page asks so often, and browsers let it ask once a minute: its title may be as old. */
const HIDDEN_MS = 1500, HIDDEN_SILENT_MS = 65000;

/** Split a stream of bytes into messages: see acquire/web/frames.py. */
export class Messages {
  #rest = new Uint8Array(0);

  /** The messages that are complete with these bytes, as [header, body]. */
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

  /** Follow for ever. A hidden page asks now and then, since browsers have six connections for all their tabs. */
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

  /** Coarse videos of what has just passed, or not: the stream is opened anew. */
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

/** Ask the API; throws an Error in the server's words. */
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
