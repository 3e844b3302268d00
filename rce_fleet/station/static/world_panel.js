// The view in three dimensions and what can be done in a simulated world: put in, move, take out, pause, reset.

import { element } from "./engine.js";
import { isCertain } from "./question.js";
import { ask } from "./requests.js";
import { t } from "./texts.js";

const REACH_M = 0.6;   // how near to something a pointer must be to take it
const TURN = 0.008;    // radians for a pixel
const PICKS = ["add_box", "add_person", "add_robot", "remove"];
const STEMS = { add_box: "box", add_person: "person", add_robot: "Robot" };
const DRAG_PX = 4;     // a pointer that moves less clicks
const ASKED = ["reset", "remove"]; // what undo does not take back
const WALK_M = 0.5;    // a drag that is shorter puts a person who stands

export class WorldPanel {
  #pointers = new Map();
  #taken = null;       // what is dragged: {before: [name, x, y, yaw] at the press, from: [x, y] of the pointer}
  #pick = null;        // what the next click does: one of PICKS
  #from = null;        // where the person who is put in begins to walk

  constructor(world, fleet, operator) {
    this.world = world;
    this.fleet = fleet;
    this.operator = operator;
    this.steers = true;
    this.note = document.querySelector("#simulation-note");
    this.outside = document.querySelector("#simulation-outside");
    document.querySelector("#views").hidden = false;
    for (const name of ["map", "both", "world"]) document.querySelector(`#view-${name}`).addEventListener("click", () => this.show(name));
    const { canvas } = world;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, (event) => this.#up(event));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.#zoom(Math.exp(event.deltaY * 0.0012)); }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.#key(event));
    for (const type of ["world", "things"]) fleet.addEventListener(type, () => this.#drawState());
    for (const type of ["things", "state", "changes"]) fleet.addEventListener(type, () => this.#tellOutside());
    const buttons = document.querySelector("#simulation-buttons");
    for (const action of ["pause", "resume", "reset", ...PICKS]) {
      const button = element("button", t(`simulation.${action}`));
      button.type = "button";
      button.id = `simulation-${action}`;
      button.addEventListener("click", () => (PICKS.includes(action) ? this.#choose(action) : this.#act({ action })));
      buttons.append(button);
    }
    this.#tell();
  }

  #drawState() {
    const { isPaused } = this.fleet;
    document.querySelector("#simulation").hidden = !this.steers;
    document.querySelector("#simulation-pause").hidden = isPaused;
    document.querySelector("#simulation-resume").hidden = !isPaused;
    this.#tell();
  }

  #tell() {
    const text = t(this.#pick ? `simulation.${this.#pick}.hint` : this.fleet.isPaused ? "simulation.starts" : "simulation.help");
    if (this.note.textContent !== text) this.note.textContent = text;
  }

  // Robots that the fleet does not have: nothing else on the page shows them.
  #tellOutside() {
    const { things, robots } = this.fleet;
    const outside = Object.keys(things).filter((name) => things[name][0] === "robot" && !robots.has(name));
    const text = outside.length ? t("simulation.outside", { robots: outside.join(", ") }) : "";
    if (this.outside.textContent !== text) this.outside.textContent = text;
  }

  show(name) {
    for (const other of ["map", "both", "world"]) document.querySelector(`#view-${other}`).setAttribute("aria-pressed", other === name);
    document.querySelector("#stage").hidden = name === "world";
    document.querySelector("#stage-world").hidden = name === "map";
    document.querySelector("#stages").classList.toggle("both", name === "both");
    this.world.shown = name !== "map";
  }

  #choose(action) {
    this.#pick = this.#pick === action ? null : action;
    for (const pick of PICKS) document.querySelector(`#simulation-${pick}`).setAttribute("aria-pressed", pick === this.#pick);
    this.#tell();
    if (this.#pick && !this.world.shown) this.show("both");
  }

  // before: what is moved, where it was: [name, x, y, yaw].
  async #act(request, before = null) {
    const { action, name } = request;
    if (ASKED.includes(action) && !(await isCertain(action, { name }))) return null;
    return this.operator.act(t("simulation"), () => ask("POST", "/simulation", request), this.#undo(request, before));
  }

  #undo({ action, name }, before) {
    if (action in STEMS) return () => ask("POST", "/simulation", { action: "remove", name });
    if (action === "move" && before) return () => ask("POST", "/simulation", { action, name, x: before[1], y: before[2], yaw: before[3] });
    return null;
  }

  #nearest([x, y]) {
    let [best, nearest] = [null, REACH_M];
    for (const model of this.fleet.models) {
      const distance = Math.hypot(model[1] - x, model[2] - y);
      if (distance < nearest) [best, nearest] = [model, distance];
    }
    return best;
  }

  #down(event) {
    this.world.canvas.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const at = this.world.floorAt(event);
    if (!at || event.button !== 0 || event.shiftKey || !this.steers || this.#pointers.size > 1) return;
    if (this.#pick === "add_person") return (this.#from = at);
    if (this.#pick) return this.#use(at);
    const model = this.#nearest(at);
    this.#taken = model && { before: model, from: [event.clientX, event.clientY] };
  }

  // to: where a person walks to.
  #use(at, to = null) {
    const [x, y] = at.map((value) => Math.round(100 * value) / 100);
    const action = this.#pick;
    const model = this.#nearest(at);
    this.#choose(action);
    if (action in STEMS) return this.#act({ action, name: this.#freeName(STEMS[action]), x, y, to });
    if (model) return this.#act({ action, name: model[0] });
  }

  #freeName(stem) {
    const names = new Set([...Object.keys(this.fleet.things), ...this.fleet.robots.keys()]);
    let number = 1;
    while (names.has(`${stem}${number}`)) number++;
    return `${stem}${number}`;
  }

  #move(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const [right, down] = [event.clientX - before[0], event.clientY - before[1]];
    const others = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const { orbit } = this.world;
    if (others.length) {
      const away = (place) => Math.max(10, Math.hypot(place[0] - others[0][0], place[1] - others[0][1]));
      this.#zoom(away(before) / away([event.clientX, event.clientY]));
    } else if (this.#taken) {
      const at = this.world.floorAt(event);
      const { before: [name, , , yaw], from } = this.#taken;
      const isDrag = this.world.dragged || Math.hypot(event.clientX - from[0], event.clientY - from[1]) >= DRAG_PX;
      if (at && isDrag) this.world.dragged = [name, ...at, yaw];
    } else if (this.#from) return;
    else if (event.buttons & 2 || event.shiftKey) this.#pan(right, down);
    else {
      this.world.follows = false;
      orbit.turn -= right * TURN;
      orbit.tilt = Math.min(1.55, Math.max(0.1, orbit.tilt + down * TURN));
    }
  }

  #up(event) {
    this.#pointers.delete(event.pointerId);
    const taken = this.#taken;
    this.#taken = null;
    const from = this.#from;
    this.#from = null;
    if (from && event.type === "pointerup") {
      const to = this.world.floorAt(event);
      return this.#use(from, to && Math.hypot(to[0] - from[0], to[1] - from[1]) >= WALK_M ? to : null);
    }
    const { dragged } = this.world;
    this.world.dragged = null;
    if (taken && dragged && event.type === "pointerup" && this.world.floorAt(event)) this.#moveTo(dragged, taken.before);
  }

  // While the world is paused a robot is put at its start, and its localization is told.
  async #moveTo([name, x, y, yaw], before) {
    const isStart = this.fleet.isPaused && this.fleet.things[name]?.[0] === "robot" && this.fleet.robots.has(name);
    if ((await this.#act({ action: "move", name, x, y, yaw }, before)) === null || !isStart) return;
    await this.operator.act(t("action.localize.done", { robot: name }), () => ask("PUT", `/robots/${encodeURIComponent(name)}/pose`, { x, y, yaw }));
  }

  #pan(right, down) {
    this.world.follows = false;
    const { orbit } = this.world;
    const metre = orbit.distance / this.world.canvas.clientHeight;
    orbit.x += (right * Math.sin(orbit.turn) - down * Math.cos(orbit.turn)) * metre;
    orbit.y += (-right * Math.cos(orbit.turn) - down * Math.sin(orbit.turn)) * metre;
  }

  #zoom(factor) {
    this.world.follows = false;
    const { orbit } = this.world;
    orbit.distance = Math.min(2000, Math.max(1, orbit.distance * factor));
  }

  #key(event) {
    const { orbit } = this.world;
    const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    if (event.key === "+" || event.key === "=") this.#zoom(0.8);
    else if (event.key === "-") this.#zoom(1.25);
    else if (event.key === "0") this.world.fit();
    else if (event.key in turns) {
      this.world.follows = false;
      orbit.turn += turns[event.key][0];
      orbit.tilt = Math.min(1.55, Math.max(0.1, orbit.tilt + turns[event.key][1]));
    } else return;
    event.preventDefault();
  }
}
