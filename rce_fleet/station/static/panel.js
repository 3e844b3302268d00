// The tables beside the map: robots (those in trouble first), the engine, events.

import { element, engineList } from "./engine.js";
import { colourOf } from "./model.js";

const DRAW_EVERY_MS = 200;
const TROUBLE = new Set(["unreachable", "silent", "stopping"]);

export class Panel {
  constructor(fleet) {
    this.fleet = fleet;
    this.body = document.querySelector("#robots tbody");
    this.engine = document.querySelector("#engine");
    this.carrier = document.querySelector("#carrier");
    this.events = document.querySelector("#events");
    this.summary = document.querySelector("#summary");
    for (const type of ["state", "selected"]) fleet.addEventListener(type, () => this.drawRobots());
    fleet.addEventListener("changes", () => this.#drawRobotsSoon());
    fleet.addEventListener("engine", () => this.drawEngine());
    setInterval(() => this.drawRobots(), 1000);
  }

  // Changes come up to ten times a second; the table is drawn less often.
  #drawRobotsSoon() {
    this.drawing ??= setTimeout(() => this.drawRobots(), DRAW_EVERY_MS);
  }

  drawRobots() {
    clearTimeout(this.drawing);
    this.drawing = null;
    const robots = [...this.fleet.robots.values()];
    robots.sort((a, b) => TROUBLE.has(b.state) - TROUBLE.has(a.state) || a.id.localeCompare(b.id, "en", { numeric: true }));
    this.body.replaceChildren(...robots.map((robot) => this.#row(robot)));
    const busy = robots.filter((robot) => robot.plan.length > 1).length;
    this.summary.textContent = robots.length ? `${robots.length} robots, ${busy} on the way` : "no robots yet";
  }

  #row(robot) {
    const row = element("tr");
    row.dataset.robot = robot.id;
    if (robot.reason) row.title = robot.reason;
    row.setAttribute("aria-selected", robot.id === this.fleet.selected);
    const name = element("td");
    const dot = element("span", "", "dot");
    dot.style.background = colourOf(robot.id);
    name.append(dot, robot.id);
    const age = robot.seen === null ? null : (performance.now() - robot.seen) / 1000;
    row.append(
      name,
      this.#state(robot),
      element("td", robot.cell ?? ""),
      element("td", robot.goal ?? ""),
      element("td", robot.replans),
      element("td", age === null ? "never" : age < 2 ? "now" : `${Math.round(age)} s`, age === null || age > 2 ? "warn" : "quiet"),
    );
    row.addEventListener("click", () => this.fleet.select(robot.id));
    return row;
  }

  #state(robot) {
    const cell = element("td", robot.state, TROUBLE.has(robot.state) ? "bad" : "");
    cell.title = robot.reason;
    return cell;
  }

  drawEngine() {
    const { engine } = this.fleet;
    if (!engine.error) this.carrier.textContent = engine.graph ? "ROS graph" : "Engine";
    this.engine.replaceChildren(engineList(engine));
  }

  addEvent(text, tone = "") {
    const item = element("li");
    const time = element("time", new Date().toLocaleTimeString());
    item.append(time, element("span", text, tone));
    this.events.prepend(item);
    while (this.events.children.length > 100) this.events.lastChild.remove();
  }
}
