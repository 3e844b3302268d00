// The check boxes of layers, and what there is to say about each layer.

import { element } from "./engine.js";
import { LAYERS } from "./layers.js";
import { t } from "./texts.js";

export class LayerPanel {
  #notes = new Map();
  #boxes = new Map();
  #wanted = null; // id of a robot that the page's address names, until it is known

  constructor(fleet, layers, view) {
    this.fleet = fleet;
    this.layers = layers;
    this.robot = document.querySelector("#layer-robot");
    this.list = document.querySelector("#layer-list");
    this.#addFleet("grid", true, (on) => layers.toggleGrid(on));
    const { shown } = view.scene;
    const set = (name, value, ...touched) => { shown[name] = value; view.touch(...touched); };
    this.#addFleet("paths", true, (on) => set("paths", on ? "all" : "selected", "lines"));
    this.#addFleet("goals", true, (on) => set("goals", on, "lines"));
    this.#addFleet("trails", false, (on) => set("trails", on ? "all" : "few", "lines"));
    this.#addFleet("zones", true, (on) => set("zones", on, "cells"));
    this.#addFleet("lanes", true, (on) => set("lanes", on, "overlay"));
    this.#addFleet("congestion", false, (on) => set("congestion", on, "cells"));
    for (const name of LAYERS) this.#add(name, false, (on) => layers.toggle(name, on));
    this.robot.addEventListener("change", () => layers.look(this.robot.value || null));
    fleet.addEventListener("selected", () => { if (fleet.selected) layers.look(fleet.selected); });
    for (const type of ["state", "changes"]) fleet.addEventListener(type, () => this.#listRobots());
    layers.addEventListener("change", () => this.#draw());
    setInterval(() => this.#draw(), 1000);
    this.#readAddress();
    addEventListener("hashchange", () => this.#readAddress());
    this.#listRobots();
  }

  // An address such as /#robot=Robot1&layers=map,scan shows these layers.
  #readAddress() {
    const fields = new URLSearchParams(location.hash.slice(1));
    const names = (fields.get("layers") ?? "").split(",");
    this.#wanted = fields.get("robot");
    for (const [name, box] of this.#boxes) if (names.includes(name) && !box.checked) box.click();
    this.#lookAtWanted();
  }

  #lookAtWanted() {
    if (!this.fleet.robots.has(this.#wanted)) return;
    this.layers.look(this.#wanted);
    this.#wanted = null;
  }

  #addFleet(name, checked, toggle) {
    const item = element("li");
    const row = element("label");
    const box = element("input");
    Object.assign(box, { type: "checkbox", id: `layer-${name}`, checked });
    box.addEventListener("change", () => toggle(box.checked));
    row.append(box, t(`layer.${name}`));
    item.append(row);
    document.querySelector("#fleet-layers").append(item);
  }

  #add(name, checked, toggle) {
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
    this.#boxes.set(name, box);
    row.append(box, swatch, t(`layer.${name}`));
    item.append(row, note);
    this.list.append(item);
  }

  // Rebuilt only when the robots changed, so that an open list stays open.
  #listRobots() {
    if (this.layers.robot !== null && !this.fleet.robots.has(this.layers.robot)) this.layers.look(null);
    const known = [...this.fleet.robots.keys()].join();
    if (known === this.known) return;
    this.known = known;
    const ids = known.split(",").sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
    this.robot.replaceChildren(new Option(t("layers.none"), ""), ...ids.filter(Boolean).map((id) => new Option(id, id)));
    this.#lookAtWanted();
    this.#draw();
  }

  #draw() {
    this.robot.value = this.layers.robot ?? "";
    for (const name of LAYERS) {
      const note = this.#notes.get(name);
      const text = this.layers.note(name);
      if (note.textContent !== text) note.textContent = text;
      note.className = this.layers.troubles.has(name) ? "note warn" : "note quiet";
    }
  }
}
