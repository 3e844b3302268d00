// What is beside the map: the engine and the events.

import { element, engineList } from "./engine.js";
import { t } from "./texts.js";

const MOST_EVENTS = 100;

export class Panel {
  constructor(fleet) {
    this.fleet = fleet;
    this.engine = document.querySelector("#engine");
    this.carrier = document.querySelector("#carrier");
    this.events = document.querySelector("#events");
    fleet.addEventListener("engine", () => this.drawEngine());
  }

  drawEngine() {
    const { engine } = this.fleet;
    if (!engine.error) this.carrier.textContent = t(engine.graph ? "engine.graph" : "engine");
    const focused = this.engine.contains(document.activeElement) ? document.activeElement : null;
    this.engine.replaceChildren(engineList(engine));
    if (focused?.isConnected) focused.focus({ preventScroll: true });
  }

  addEvent(text, tone = "") {
    const item = element("li");
    const time = element("time", new Date().toLocaleTimeString());
    item.append(time, element("span", text, tone));
    this.events.prepend(item);
    while (this.events.children.length > MOST_EVENTS) this.events.lastChild.remove();
  }
}
