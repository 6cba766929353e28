// Workers as functions that promise: a request to a worker that does not answer in time ends it, and starts another.

const PATIENCE_MS = 30000;

export class Refusal extends Error {}

/** Bytes that the page carries compressed as text. */
export async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(plain).arrayBuffer();
}

/** Numbers of 16 bits, as floating-point numbers. */
export const widened = (bytes) => Float32Array.from(new Uint16Array(bytes), (bits) => {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  return (bits >> 15 ? -1 : 1) * (exponent ? (1024 + fraction) * 2 ** (exponent - 25) : fraction * 2 ** -24);
});

export class Engine {
  constructor(module, source) {
    this.module = module;
    this.url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.waiting = new Map();
    this.next = 0;
    this.#start();
  }

  #start() {
    this.worker = new Worker(this.url);
    this.worker.onmessage = ({ data }) => this.#answer(data);
    this.worker.onerror = (event) => this.#end(event.message || "the worker failed");
    this.ready = this.#send("start", { module: this.module });
    this.ready.catch(() => {}); // those who ask are told
  }

  #answer({ id, done, share, refused, failed }) {
    const request = this.waiting.get(id);
    if (!request) return;
    if (share !== undefined) return request.tell?.(share);
    clearTimeout(request.timer);
    this.waiting.delete(id);
    if (done) return request.resolve(done);
    if (refused) return request.reject(new Refusal(refused));
    request.reject(new Error(failed));
    this.#end("the native code stopped"); // its memory may be in any state
  }

  #end(why) {
    this.worker.terminate();
    for (const { reject, timer } of this.waiting.values()) {
      clearTimeout(timer);
      reject(new Refusal(why));
    }
    this.waiting.clear();
    this.#start();
  }

  #send(stage, request, tell, patience) {
    const id = ++this.next;
    return new Promise((resolve, reject) => {
      const timer = patience ? setTimeout(() => this.#end("this takes too long here"), patience) : 0;
      this.waiting.set(id, { stage, resolve, reject, tell, timer });
      this.worker.postMessage({ id, stage, ...request });
    });
  }

  /** What a stage of the worker gives; `tell(share)` is called on the way. Rejects with a Refusal that says why not. */
  async ask(stage, request = {}, tell = undefined, patience = PATIENCE_MS) {
    await this.ready;
    return this.#send(stage, request, tell, patience);
  }

  /** Ends what is being computed: those who wait for it get a Refusal. */
  stop() {
    if ([...this.waiting.values()].some(({ stage }) => stage !== "start")) this.#end("stopped");
  }
}
