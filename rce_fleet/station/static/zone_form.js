// The form for a zone: a new one after its cells were dragged over, or the one that was clicked.

import { t } from "./texts.js";

// Directions are degrees on the page, and radians for the manager.
const DEGREE = Math.PI / 180;

export class ZoneForm {
  #cells = [];
  #zone = null; // the one that is changed

  constructor(tools, actions, work) {
    this.actions = actions;
    this.work = work;
    this.form = document.querySelector("#zone-form");
    this.name = document.querySelector("#zone-name");
    this.kind = document.querySelector("#zone-kind");
    this.value = document.querySelector("#zone-value");
    this.remove = document.querySelector("#zone-remove");
    tools.addEventListener("zone", ({ detail }) => this.#open(detail));
    tools.addEventListener("chosen", () => this.#close());
    document.querySelector("#zone-cancel").addEventListener("click", () => this.#close());
    this.remove.addEventListener("click", async () => { if (await actions.removeZone(this.#zone.id)) this.#close(); });
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#submit();
    });
  }

  #open(cells) {
    const known = cells.length === 1 ? this.work.zones.find((zone) => zone.cells.includes(cells[0])) : null;
    this.#zone = known ?? null;
    this.#cells = known?.cells ?? cells;
    this.name.value = known?.id ?? this.#freeName();
    this.name.readOnly = Boolean(known);
    if (known) this.kind.value = known.kind;
    const value = known?.value ?? null;
    if (value === null) this.value.value = "";
    else this.value.value = known.kind === "one_way" ? Math.round(value / DEGREE) : value;
    this.remove.hidden = !known;
    this.form.hidden = false;
    this.kind.focus();
  }

  #close() {
    this.form.hidden = true;
  }

  #freeName() {
    const used = new Set(this.work.zones.map(({ id }) => id));
    let number = used.size + 1;
    while (used.has(`zone${number}`)) number++;
    return `zone${number}`;
  }

  async #submit() {
    const { kind, name, value } = this;
    const number = value.value === "" ? null : value.valueAsNumber * (kind.value === "one_way" ? DEGREE : 1);
    const { reason = t("zone.title"), until = null, robots = [], edges = [] } = this.#zone ?? {};
    const rule = { kind: kind.value, value: number, edges: kind.value === "blocked" ? edges : [] };
    const zone = { ...rule, cells: this.#cells, reason, until, robots };
    if (await this.actions.makeZone(name.value, zone, this.#zone)) this.#close();
  }
}
