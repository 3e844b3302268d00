// The check boxes of layers, and what there is to say about each layer.

import { element } from "./engine.js";
import { LAYERS } from "./layers.js";

export class LayerPanel {
  #notes = new Map();

  constructor(fleet, layers) {
    this.fleet = fleet;
    this.layers = layers;
    this.robot = document.querySelector("#layer-robot");
    this.list = document.querySelector("#layer-list");
    this.#add("grid", "Fleet grid", true, (on) => layers.toggleGrid(on));
    for (const { name, label } of LAYERS) this.#add(name, label, false, (on) => layers.toggle(name, on));
    this.robot.addEventListener("change", () => layers.look(this.robot.value || null));
    fleet.addEventListener("selected", () => { if (fleet.selected) layers.look(fleet.selected); });
    for (const type of ["state", "changes"]) fleet.addEventListener(type, () => this.#listRobots());
    layers.addEventListener("change", () => this.#draw());
    setInterval(() => this.#draw(), 1000);
    this.#listRobots();
  }

  #add(name, label, checked, toggle) {
    const item = element("li");
    const row = element("label");
    const box = element("input");
    Object.assign(box, { type: "checkbox", id: `layer-${name}`, checked });
    box.setAttribute("aria-describedby", `layer-note-${name}`);
    box.addEventListener("change", () => toggle(box.checked));
    const swatch = element("span", "", `swatch ${name}`);
    swatch.setAttribute("aria-hidden", "true");
    const note = element("span", "", "note");
    note.id = `layer-note-${name}`;
    this.#notes.set(name, note);
    row.append(box, swatch, label);
    item.append(row, note);
    this.list.append(item);
  }

  // Rebuilt only when the robots changed, so that an open list stays open.
  #listRobots() {
    const ids = [...this.fleet.robots.keys()].sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
    if (this.layers.robot !== null && !this.fleet.robots.has(this.layers.robot)) this.layers.look(null);
    if (ids.join() === this.ids) return;
    this.ids = ids.join();
    this.robot.replaceChildren(new Option("none", ""), ...ids.map((id) => new Option(id, id)));
    this.#draw();
  }

  #draw() {
    this.robot.value = this.layers.robot ?? "";
    for (const { name } of LAYERS) {
      const note = this.#notes.get(name);
      const text = this.layers.note(name);
      if (note.textContent !== text) note.textContent = text;
      note.className = this.layers.troubles.has(name) ? "note warn" : "note quiet";
    }
  }
}
