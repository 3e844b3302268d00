// Why, and for how long, cells are blocked that are clicked or dragged over: two fields while the tool for it is chosen.

export class BlockFields {
  constructor(tools) {
    this.fields = document.querySelector("#block-fields");
    this.reason = document.querySelector("#block-reason");
    this.minutes = document.querySelector("#block-minutes");
    tools.addEventListener("chosen", () => { this.fields.hidden = tools.tool !== "block"; });
    tools.blockDetails = () => this.#details();
  }

  // What a request says that is sent now: only what was filled in; until is seconds since 1970.
  #details() {
    const reason = this.reason.value.trim();
    const minutes = this.minutes.validity.valid ? this.minutes.valueAsNumber : NaN;
    return { ...(reason && { reason }), ...(minutes > 0 && { until: Date.now() / 1000 + 60 * minutes }) };
  }
}
