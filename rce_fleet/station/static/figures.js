// Figures of the fleet over time, as the station recorded them: what robots do, and the manager's statistics.

import { element } from "./engine.js";
import { ask } from "./requests.js";
import { t } from "./texts.js";

const EVERY_MS = 5000;
const HOURS = [1, 4, 24];
const GAP_S = 60; // without a sample for so long the line is broken

const NUMBER = (value) => String(Math.round(10 * value) / 10);
const SHARE = (value) => t("unit.percent", { percent: Math.round(100 * value) });
const FIGURES = [
  { name: "moving" },
  { name: "waiting" },
  { name: "battery", show: SHARE, most: 1 },
  { name: "done" },
  { name: "open" },
  { name: "utilization", show: SHARE, most: 1 },
  { name: "wait", show: (value) => t("age.seconds", { seconds: Math.round(value) }) },
  { name: "late" },
];

export class Figures {
  #parts = new Map();
  #number = 0;

  constructor() {
    this.box = document.querySelector("#figures");
    this.span = document.querySelector("#figures-span");
    this.span.append(...HOURS.map((hours) => new Option(t("figures.hours", { hours }), hours)));
    this.span.addEventListener("change", () => this.read());
    setInterval(() => { if (!document.hidden) this.read(); }, EVERY_MS);
    this.read();
  }

  async read() {
    const number = ++this.#number;
    const seconds = 3600 * Number(this.span.value);
    const { times, figures } = await ask("GET", `/figures?seconds=${seconds}`).catch(() => ({ times: [], figures: {} }));
    if (number !== this.#number || !times.length) return;
    document.querySelector("#figures-section").hidden = false;
    for (const figure of FIGURES) if (figure.name in figures) this.#draw(figure, times, figures[figure.name]);
  }

  #part(name) {
    let part = this.#parts.get(name);
    if (!part) {
      const figure = element("figure");
      const caption = element("figcaption");
      part = { value: element("b"), canvas: element("canvas") };
      part.canvas.setAttribute("role", "img");
      caption.append(t(`figures.${name}`), part.value);
      figure.append(caption, part.canvas);
      this.box.append(figure);
      this.#parts.set(name, part);
    }
    return part;
  }

  #draw({ name, show = NUMBER, most }, times, values) {
    const { canvas, value } = this.#part(name);
    const known = values.filter((one) => one !== null);
    if (!known.length) return;
    const [low, high] = [Math.min(...known), Math.max(...known)];
    const last = values.at(-1);
    value.textContent = last === null ? "" : show(last);
    canvas.title = t("figures.range", { low: show(low), high: show(high) });
    canvas.setAttribute("aria-label", `${t(`figures.${name}`)}: ${value.textContent} (${canvas.title})`);
    const width = (canvas.width = Math.max(1, canvas.clientWidth * devicePixelRatio));
    const height = (canvas.height = Math.max(1, canvas.clientHeight * devicePixelRatio));
    const context = canvas.getContext("2d");
    context.strokeStyle = context.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent");
    context.lineWidth = 1.5 * devicePixelRatio;
    const [first, end, top] = [times[0], times.at(-1), most ?? Math.max(1, high * 1.1)];
    const x = (at) => (end > first ? ((at - first) / (end - first)) * width : width);
    const y = (one) => height - 2 - (one / top) * (height - 4);
    for (const run of runsOf(times, values)) {
      context.globalAlpha = 1;
      context.beginPath();
      for (const [at, one] of run) context.lineTo(x(at), y(one));
      context.stroke();
      context.lineTo(x(run.at(-1)[0]), height);
      context.lineTo(x(run[0][0]), height);
      context.globalAlpha = 0.15;
      context.fill();
    }
  }
}

// The parts of a line between gaps: lists of [time, value].
function runsOf(times, values) {
  const gap = Math.max(GAP_S, (3 * (times.at(-1) - times[0])) / Math.max(1, times.length));
  const runs = [];
  let before = -Infinity;
  values.forEach((value, index) => {
    if (value === null) return;
    if (times[index] - before > gap) runs.push([]);
    runs.at(-1).push([times[index], value]);
    before = times[index];
  });
  return runs;
}
