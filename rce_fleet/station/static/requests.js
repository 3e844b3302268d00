// Requests to the station, and what the operator did, to be undone.

import { t } from "./texts.js";

const MOST_UNDO = 20;

// Send a request; return the answer, or throw an error with its text and status.
export async function ask(method, path, body, headers = {}) {
  const response = await fetch(path.startsWith("/api") ? path : `/api/v1${path}`, {
    method,
    headers: { "Content-Type": "application/json", ...headers },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  const text = await response.text();
  let answer = {};
  try {
    answer = text ? JSON.parse(text) : {};
  } catch {
    answer = { error: text.slice(0, 200) };
  }
  if (!response.ok) throw Object.assign(new Error(answer.error ?? response.statusText), { status: response.status });
  return answer;
}

export class Operator extends EventTarget {
  #done = []; // {label, undo, running: a promise of its answer, null if it was refused}

  // say: (text, bad) => shows it; note: (text) => adds an event
  constructor(say, note) {
    super();
    this.say = say;
    this.note = note;
  }

  get undoable() {
    return this.#done.at(-1)?.label ?? null;
  }

  // Do something and tell its result; undo: a function that takes it back, or null. It can be undone before it is answered.
  async act(label, run, undo = null) {
    const running = this.#run(label, run);
    if (!undo) return running;
    const entry = { label, undo, running };
    this.#done.push(entry);
    if (this.#done.length > MOST_UNDO) this.#done.shift();
    const answer = await running;
    if (answer === null) this.#done = this.#done.filter((other) => other !== entry);
    this.dispatchEvent(new Event("acted"));
    return answer;
  }

  // The answer; null if it was refused.
  async #run(label, run) {
    try {
      const answer = await run();
      const text = answer?.message || t("done", { label });
      // What was not done for every robot or cell stays in the list of events, as an emergency stop.
      const isPartial = Boolean(answer?.missed?.length);
      this.say(text, isPartial);
      if (isPartial) this.note(text);
      this.dispatchEvent(new Event("acted"));
      return answer ?? true;
    } catch (error) {
      this.say(error.message, true);
      this.note(error.message);
      return null;
    }
  }

  // Take back the last action. If that is refused, it can be tried again.
  async undo() {
    const last = this.#done.pop();
    if (!last || (await last.running) === null) return;
    if ((await this.act(t("undo.done", { label: last.label }), last.undo)) !== null) return;
    this.#done.push(last);
    this.dispatchEvent(new Event("acted"));
  }
}
