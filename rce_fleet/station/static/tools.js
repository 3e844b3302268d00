// What pointers do on the map: send robots, block and free cells, make zones, set poses, make tasks.

import { t } from "./texts.js";

// Tools: act (click: a robot, its goal, or a cell to block), block, free, zone, pose, task; load (no button of its own).
export class Tools extends EventTarget {
  tool = "act";
  steers = true;
  blockDetails = () => ({}); // reason and end of cells that are blocked with the tool for it
  isPast = () => false; // whether the map shows a past moment, or loads it: nothing is sent to the fleet of now
  #drag = null;   // {from: [x, y], to: [x, y], robot}
  #loadOf = null; // the task of the tool load
  #pick = null;   // first cell of a task, or where a robot is that is localized without a drag

  constructor(view, fleet, actions) {
    super();
    this.view = view;
    this.fleet = fleet;
    this.actions = actions;
    view.overlay.preview = (context, camera, colour) => this.#draw(context, camera, colour);
  }

  choose(tool) {
    this.tool = tool;
    this.#pick = null;
    this.cancel();
    this.dispatchEvent(new Event("chosen"));
  }

  // The next click says where the load of a task is.
  chooseLoad(task) {
    this.#loadOf = task;
    this.choose("load");
  }

  // What the operator should do next.
  get hint() {
    const robot = this.fleet.selected;
    if (!this.steers) return t("hint.viewer");
    if (this.isPast()) return t("hint.past");
    if (this.tool === "act" && robot) return t("hint.goal", { robot });
    if (this.tool === "pose" && !robot) return t("hint.poseRobot");
    if (this.tool === "pose" && this.#pick !== null) return t("hint.look", { robot });
    if (this.tool === "task" && this.#pick !== null) return t("hint.drop", { cell: this.#pick });
    return t(`hint.${this.tool}`, { robot, task: this.#loadOf });
  }

  // Tell that the map shows a past moment, if it does.
  #refusePast() {
    if (!this.isPast()) return false;
    this.actions.operator.say(t("hint.past"), true);
    return true;
  }

  #robotAt(x, y) {
    const reach = Math.max(0.35 * this.fleet.map.cell_size, (10 * devicePixelRatio) / this.view.scale);
    return this.fleet.robotAt(x, y, reach, this.view.scene.shownRobots);
  }

  // Gestures ask whether a drag belongs to the tool.
  begin(event) {
    if (!this.fleet.map || !this.steers || this.isPast()) return false;
    const at = this.view.worldAt(event);
    const robot = this.#robotAt(...at);
    const takes = { act: robot !== null, block: true, free: true, zone: true, pose: this.fleet.selected !== null, task: false, load: false };
    if (!takes[this.tool]) return false;
    this.#drag = { from: at, to: at, robot: robot?.id ?? null };
    return true;
  }

  move(event) {
    if (!this.#drag) return;
    this.#drag.to = this.view.worldAt(event);
    this.view.cursorCell = this.fleet.cellAt(...this.#drag.to);
    this.view.touch("overlay");
  }

  cancel() {
    this.#drag = null;
    this.view.touch("overlay");
  }

  end(event) {
    const drag = this.#drag;
    if (!drag) return;
    this.move(event);
    this.cancel();
    if (this.#refusePast()) return;
    const { from, to, robot } = drag;
    const cell = this.fleet.cellAt(...to);
    if (this.tool === "act" && robot && cell !== null) return this.actions.sendTo(robot, cell);
    if (this.tool === "block" || this.tool === "free") return this.#set(this.cellsBetween(from, to));
    if (this.tool === "zone") return this.dispatchEvent(new CustomEvent("zone", { detail: this.cellsBetween(from, to) }));
    this.#pick = null;
    if (this.tool === "pose") return this.actions.setPose(this.fleet.selected, ...from, Math.atan2(to[1] - from[1], to[0] - from[0]));
  }

  click(event) {
    if (!this.fleet.map) return;
    const at = this.view.worldAt(event);
    const robot = this.#robotAt(...at);
    const cell = this.fleet.cellAt(...at);
    const selects = this.tool === "act" || this.tool === "pose" || !this.steers;
    if (robot && selects && this.fleet.robots.has(robot.id)) return this.fleet.select(robot.id);
    if (cell !== null && this.steers) this.use(cell);
  }

  // A click on a cell, or Enter.
  use(cell) {
    if (!this.steers || this.#refusePast()) return;
    const { fleet, actions } = this;
    const shut = fleet.blocked.has(cell) || fleet.pending.has(cell);
    if (this.tool === "act" && fleet.selected) {
      const robot = fleet.selected;
      fleet.select(robot);
      actions.sendTo(robot, cell);
    } else if (this.tool === "act") actions.setCells([cell], !shut) ?? null;
    else if (this.tool === "block" || this.tool === "free") this.#set([cell]);
    else if (this.tool === "zone") this.dispatchEvent(new CustomEvent("zone", { detail: [cell] }));
    else if (this.tool === "task") this.#pickOrDrop(cell);
    else if (this.tool === "load") this.#placeLoad(cell);
    else if (this.tool === "pose" && fleet.selected) this.#placeOrTurn(cell);
  }

  // Block or free cells.
  #set(cells) {
    const blocked = this.tool === "block";
    return this.actions.setCells(cells, blocked, blocked ? this.blockDetails() : {});
  }

  // Two cells instead of a drag, for a keyboard: where the robot is, and which cell it looks towards.
  #placeOrTurn(cell) {
    const place = this.#pick;
    this.#pick = place === null ? cell : null;
    if (place !== null && place !== cell) {
      const [[x0, y0], [x1, y1]] = [place, cell].map((one) => this.fleet.centre(one));
      this.actions.setPose(this.fleet.selected, x0, y0, Math.atan2(y1 - y0, x1 - x0));
    }
    this.view.touch("overlay");
    this.dispatchEvent(new Event("chosen"));
  }

  async #placeLoad(cell) {
    if ((await this.actions.settleLoad(this.#loadOf, cell)) !== null) this.choose("act");
  }

  async #pickOrDrop(cell) {
    if (this.#pick === null) {
      this.#pick = cell;
    } else {
      const pick = this.#pick;
      this.#pick = null;
      await this.actions.createTask([{ action: "pick", cell: pick }, { action: "deliver", cell }]);
    }
    this.view.touch("overlay");
    this.dispatchEvent(new Event("chosen"));
  }

  hover(event) { if (this.fleet.map) this.view.cursorCell = this.fleet.cellAt(...this.view.worldAt(event)); }
  leave() { this.view.cursorCell = null; }

  // Cells of a rectangle between two points, in the grid's own rows and columns.
  cellsBetween(from, to) {
    const { columns } = this.fleet.map;
    const [a, b] = [from, to].map((point) => this.fleet.cellAt(...point));
    if (a === null || b === null) return [a ?? b].filter((cell) => cell !== null);
    const [r0, r1] = [Math.floor(a / columns), Math.floor(b / columns)].sort((x, y) => x - y);
    const [c0, c1] = [a % columns, b % columns].sort((x, y) => x - y);
    const cells = [];
    for (let row = r0; row <= r1; row++) for (let column = c0; column <= c1; column++) cells.push(row * columns + column);
    return cells;
  }

  #draw(context, camera, colour) {
    if (this.#pick === null && !this.#drag) return false;
    const side = this.fleet.map.cell_size * camera.scale;
    const mark = (cell) => {
      const [x, y] = this.fleet.centre(cell);
      context.fillRect(camera.x(x) - side / 2, camera.y(y) - side / 2, side, side);
    };
    context.save();
    context.fillStyle = context.strokeStyle = colour.accent;
    context.lineWidth = 3 * devicePixelRatio;
    if (this.#pick !== null) {
      context.globalAlpha = 0.5;
      mark(this.#pick);
    }
    if (this.#drag && ["block", "free", "zone"].includes(this.tool)) {
      context.globalAlpha = 0.35;
      for (const cell of this.cellsBetween(this.#drag.from, this.#drag.to)) mark(cell);
    } else if (this.#drag) {
      const [x0, y0, x1, y1] = [camera.x(this.#drag.from[0]), camera.y(this.#drag.from[1]), camera.x(this.#drag.to[0]), camera.y(this.#drag.to[1])];
      const angle = Math.atan2(y1 - y0, x1 - x0);
      context.beginPath();
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
      for (const turn of [2.6, -2.6]) {
        context.moveTo(x1, y1);
        context.lineTo(x1 + 14 * devicePixelRatio * Math.cos(angle + turn), y1 + 14 * devicePixelRatio * Math.sin(angle + turn));
      }
      context.stroke();
    }
    context.restore();
    return true;
  }
}
