// The form for a zone: a new one after its cells were dragged over, or the one that was clicked.

// Directions are degrees on the page, and radians for the manager.
const DEGREE = Math.PI / 180;

export class ZoneForm {
  #cells = [];
  #zone = null; // the one that is changed
  #isSending = false; // a second click would be refused: the zone exists then

  constructor(tools, actions, work) {
    this.actions = actions;
    this.work = work;
    this.form = document.querySelector("#zone-form");
    this.name = document.querySelector("#zone-name");
    this.kind = document.querySelector("#zone-kind");
    this.value = document.querySelector("#zone-value");
    this.reason = document.querySelector("#zone-reason");
    this.until = document.querySelector("#zone-until");
    this.robots = document.querySelector("#zone-robots");
    this.edges = document.querySelector("#zone-edges");
    this.remove = document.querySelector("#zone-remove");
    tools.addEventListener("zone", ({ detail }) => this.#open(detail));
    tools.addEventListener("chosen", () => this.#close());
    document.querySelector("#zone-cancel").addEventListener("click", () => this.#close());
    this.remove.addEventListener("click", async () => { if (await actions.removeZone(this.#zone)) this.#close(); });
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
    this.reason.value = known?.reason ?? "";
    this.until.value = known?.until ? localTime(known.until) : "";
    this.robots.value = known?.robots.join(", ") ?? "";
    this.edges.value = known?.edges.map(([from, to]) => `${from}>${to}`).join(", ") ?? "";
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
    if (this.#isSending) return;
    const { kind, name, value } = this;
    const number = value.value === "" ? null : value.valueAsNumber * (kind.value === "one_way" ? DEGREE : 1);
    const words = (text) => text.split(",").map((word) => word.trim()).filter(Boolean);
    const zone = {
      kind: kind.value,
      value: number,
      cells: this.#cells,
      reason: this.reason.value,
      until: this.#end(),
      robots: words(this.robots.value),
      edges: words(this.edges.value).map((move) => move.split(">").map(Number)),
    };
    this.#isSending = true;
    const answer = await this.actions.makeZone(name.value, zone, this.#zone);
    this.#isSending = false;
    if (answer) this.#close();
  }

  // When it ends, seconds since 1970; an end that was not changed keeps its fractions.
  #end() {
    const text = this.until.value;
    if (!text) return null;
    const before = this.#zone?.until;
    return before && localTime(before) === text ? before : new Date(text).getTime() / 1000;
  }
}

// A time as the input for it has it.
function localTime(seconds) {
  const at = new Date(1000 * seconds);
  return new Date(at.getTime() - 60000 * at.getTimezoneOffset()).toISOString().slice(0, 16);
}
