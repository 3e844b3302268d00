// The last hours again: a slider over what the station recorded, and playing on from there.

import { ask } from "./requests.js";
import { t } from "./texts.js";
import { Trail } from "./trail.js";

const STEPS = 1000;
const WINDOW_S = 60;
const ASK_AGAIN_MS = 15000;

export class Replay extends EventTarget {
  #span = null;      // {first, last}, seconds since 1970
  #frames = [];      // of the window that is loaded
  #at = null;        // the moment that is shown; null: live
  #playing = false;
  #robots = new Map();
  #isLoading = false;

  // say: (text, bad) => shows it
  constructor(view, fleet, say) {
    super();
    this.view = view;
    this.fleet = fleet;
    this.say = say;
    this.box = document.querySelector("#replay");
    this.slider = document.querySelector("#replay-time");
    this.output = document.querySelector("#replay-at");
    this.live = document.querySelector("#replay-live");
    this.play = document.querySelector("#replay-play");
    this.box.hidden = false;
    this.slider.addEventListener("input", () => this.#slide());
    this.live.addEventListener("click", () => this.goLive());
    this.play.addEventListener("click", () => this.#setPlaying(!this.#playing));
    setInterval(() => this.#readSpan(), ASK_AGAIN_MS);
    setInterval(() => this.#tick(), 1000);
    this.#readSpan();
    this.#tell();
  }

  get at() { return this.#at; }

  async #readSpan() {
    const span = await ask("GET", "/replay").catch(() => null);
    this.#span = span?.first ? span : null;
  }

  async #slide() {
    if (!this.#span) await this.#readSpan();
    if (!this.#span) return (this.output.textContent = t("replay.empty"));
    const { first, last } = this.#span;
    await this.#showOrGoLive(first + ((last - first) * this.slider.valueAsNumber) / STEPS);
  }

  // The fleet of now must not look like a past one that could not be loaded.
  async #showOrGoLive(at) {
    try {
      await this.show(at);
    } catch (error) {
      this.goLive();
      this.say(t("replay.failed", { reason: error.message }), true);
    }
  }

  // Show a moment, seconds since 1970. While another one is loaded it is noted, and is the next one.
  async show(at) {
    this.#at = at;
    if (this.#isLoading) return this.#tell();
    this.#isLoading = true;
    try {
      await this.#showNewest();
    } finally {
      this.#isLoading = false;
      this.#tell();
    }
  }

  // Until the newest moment that was asked for is shown: one load at a time, else each would take the place of one that is nearly there.
  async #showNewest() {
    let at = null;
    while (this.#at !== null && this.#at !== at) {
      at = this.#at;
      try {
        if (!this.#isLoaded(at)) await this.#load(at);
      } catch (error) {
        if (this.#at === at) throw error;
        continue;
      }
      if (this.#at !== null) this.#takeUntil(at);
    }
  }

  #isLoaded(at) {
    const first = this.#frames[0]?.time;
    return first !== undefined && at >= first && at <= first + WINDOW_S - 1 && at >= this.shown;
  }

  async #load(at) {
    this.#tell();
    const { frames } = await ask("GET", `/replay/${at}?seconds=${WINDOW_S}`);
    if (this.#at === null) return;
    this.#frames = frames;
    this.#robots.clear();
    this.taken = 0;
  }

  // Apply the frames up to a moment.
  #takeUntil(at) {
    this.shown = at;
    const replay = this.view.scene.replay ?? { robots: this.#robots, blocked: [], pending: [] };
    while (this.taken < this.#frames.length && this.#frames[this.taken].time <= at) {
      const frame = this.#frames[this.taken++];
      if (frame.whole) for (const id of this.#robots.keys()) if (!(id in frame.robots)) this.#robots.delete(id);
      for (const [id, row] of Object.entries(frame.robots)) this.#takeRobot(id, row);
      for (const id of frame.removed ?? []) this.#robots.delete(id);
      if (frame.blocked) replay.blocked = frame.blocked;
      if (frame.pending) replay.pending = frame.pending;
    }
    this.view.scene.replay = replay;
    this.view.touch("cells", "lines", "overlay", "fleet");
  }

  #takeRobot(id, [x, y, theta, state, cell, goal, base]) {
    const robot = this.#robots.get(id) ?? { id, shown: null, trail: new Trail() };
    const plan = cell === null ? [] : [cell, ...base.filter((end) => end !== cell)];
    Object.assign(robot, { pose: x === null ? null : { x, y, theta }, state, cell, goal, plan, granted: plan });
    if (x !== null) robot.trail.add(x, y);
    this.#robots.set(id, robot);
  }

  #tick() {
    if (!this.#playing || this.#at === null || this.#isLoading) return;
    const next = this.#at + 1;
    if (this.#span && next > this.#span.last + ASK_AGAIN_MS / 1000) return this.goLive();
    if (this.#span) this.slider.value = (STEPS * (next - this.#span.first)) / Math.max(1, this.#span.last - this.#span.first);
    this.#showOrGoLive(next);
  }

  #setPlaying(on) {
    this.#playing = on && this.#at !== null;
    this.#tell();
  }

  goLive() {
    this.#at = null;
    this.#playing = false;
    this.#frames = [];
    this.slider.value = STEPS;
    this.view.scene.replay = null;
    this.view.touch("cells", "lines", "overlay", "fleet");
    this.#tell();
  }

  #tell() {
    this.live.setAttribute("aria-pressed", this.#at === null);
    this.play.setAttribute("aria-pressed", this.#playing);
    this.play.disabled = this.#at === null;
    const text = this.#at === null ? "" : timeText(new Date(1000 * this.#at));
    this.output.textContent = text && this.#isLoading ? t("replay.loading") : text;
    this.slider.setAttribute("aria-valuetext", text || t("replay.live"));
    this.view.stage.classList.toggle("past", this.#at !== null);
    this.dispatchEvent(new Event("change"));
  }
}

// The records may be of yesterday.
function timeText(at) {
  return at.toDateString() === new Date().toDateString() ? at.toLocaleTimeString() : at.toLocaleString();
}
