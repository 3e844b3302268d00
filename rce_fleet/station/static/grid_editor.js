// Another grid of cells: its numbers, its picture over the map, and taking it over.

import { isCertain } from "./question.js";
import { t } from "./texts.js";

const WAIT_MS = 300; // after the last key, before the planner is asked
const DEGREES = 180 / Math.PI;

export class GridEditor extends EventTarget {
  proposed = null; // the grid that is shown: {rows, columns, cell_size, origin, yaw, walls}
  #asked = 0;      // number of the newest request: an older answer is not shown

  // ask: (method, path, body) => the planner's answer; throws an error with its text.
  constructor(fleet, ask) {
    super();
    this.fleet = fleet;
    this.ask = ask;
    this.form = document.querySelector("#grid-editor");
    this.note = document.querySelector("#grid-note");
    this.take = document.querySelector("#grid-take");
    this.fields = Object.fromEntries(["size", "x", "y", "yaw", "share"].map((name) => [name, document.querySelector(`#grid-${name}`)]));
    this.form.addEventListener("toggle", () => (this.form.open ? this.#begin() : this.#end()));
    for (const field of Object.values(this.fields)) field.addEventListener("input", () => this.#changed());
    document.querySelector("#grid-cancel").addEventListener("click", () => { this.form.open = false; });
    this.take.addEventListener("click", () => this.#takeOver());
    fleet.addEventListener("map", () => { if (this.form.open) this.#begin(); });
  }

  // Begin with the grid that the fleet has.
  #begin() {
    const { map } = this.fleet;
    if (!map) return this.#say(t("grid.unknown"), true);
    const [x, y] = map.origin;
    const shown = { size: map.cell_size, x, y, yaw: (map.yaw ?? 0) * DEGREES };
    for (const [name, value] of Object.entries(shown)) this.fields[name].value = Number(value.toFixed(4));
    this.fields.share.value = "";
    this.#preview();
  }

  #end() {
    clearTimeout(this.timer);
    this.#asked++;
    this.#show(null);
    this.#say("");
  }

  #changed() {
    this.take.disabled = true;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#preview(), WAIT_MS);
  }

  // What the fields say; undefined if one cannot be read.
  #request() {
    if (!Object.values(this.fields).every((field) => field.checkValidity())) return undefined;
    const { size, x, y, yaw, share } = this.fields;
    const request = { cell_size: size.valueAsNumber, origin: [x.valueAsNumber, y.valueAsNumber], yaw: yaw.valueAsNumber / DEGREES };
    if (share.value !== "") request.blocked_share = share.valueAsNumber / 100;
    return request;
  }

  async #preview() {
    const request = this.#request();
    if (!request) return this.#say(t("grid.number"), true);
    const number = ++this.#asked;
    this.#say(t("grid.waiting"));
    try {
      const grid = await this.ask("POST", "/api/v1/grid/preview", request);
      if (number !== this.#asked) return;
      if (this.fields.share.value === "") this.fields.share.value = Number((100 * grid.blocked_share).toFixed(2));
      this.#show(grid);
      this.#say(t("grid.says", { columns: grid.columns, rows: grid.rows, walls: grid.walls.length, message: grid.message }));
    } catch (error) {
      if (number !== this.#asked) return;
      this.#show(null);
      this.#say(error.message, true);
    }
  }

  async #takeOver() {
    const request = this.#request();
    if (!request || !(await isCertain("grid"))) return;
    this.take.disabled = true;
    try {
      const answer = await this.ask("PUT", "/api/v1/grid", request);
      this.form.open = false;
      this.dispatchEvent(new CustomEvent("taken", { detail: answer.message }));
    } catch (error) {
      this.take.disabled = false;
      this.#say(error.message, true);
    }
  }

  #show(grid) {
    this.proposed = grid && { ...grid, walls: new Set(grid.walls) };
    this.take.disabled = !grid;
    this.dispatchEvent(new Event("shown"));
  }

  #say(text, bad = false) {
    this.note.textContent = text;
    this.note.className = bad ? "bad" : "quiet";
  }
}
