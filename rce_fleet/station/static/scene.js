// What is drawn of the fleet, as numbers: cells, lines and robots. Both renderers draw it; independent of the screen.

import { rgbOf } from "./colours.js";
import { markOf } from "./conditions.js";
import { packed, roomFor } from "./gl.js";

export const CELL = { free: 0, wall: 1, blocked: 2, pending: 3 };
// Items are rows of numbers, four in a texel of the renderer's texture.
export const LINE_TEXELS = 2;   // x0, y0, x1, y1; colour, alpha, width in pixels, dashes
export const ROBOT_TEXELS = 2;  // x, y, yaw, look; colour, three that are not used
export const LOOK = { selected: 1, mark: 2, loaded: 16 }; // look: selected + 2 * mark + 16 * loaded
const ROBOT = 4 * ROBOT_TEXELS;
const LINE = 4 * LINE_TEXELS;
const SMOOTH_S = 0.12;          // time constant of a robot's motion to its newest pose
const JUMP_M = 3;               // a robot that is farther away is not slid there
const STILL = 0.002;
const TRAIL_OF_MANY = 60;       // points of a trail with more robots than MANY
export const MANY = 60;
const CROWD = 300;              // from so many robots on, plans and goals of others than the selected one are pale

export class Scene {
  cells = new Uint8Array(0);    // four bytes for each cell: CELL, congestion, zone, not used
  cellsVersion = 0;
  lines = new Float32Array(0);
  lineCount = 0;
  linesVersion = 0;
  robots = new Float32Array(0);
  robotCount = 0;
  shown = { paths: "all", trails: "few", goals: true, congestion: false, zones: true, lanes: true };
  zones = [];                   // {id, cells, ...}
  extra = [];                   // further lines: {points: [[x, y], ...], colour: [r, g, b], width, dash}
  replay = null;                // a moment of the past that is shown instead: {robots: Map}
  constructor(fleet) {
    this.fleet = fleet;
  }

  get shownRobots() {
    return this.replay ? this.replay.robots : this.fleet.robots;
  }

  // Numbers of cells changed: all are made again.
  makeCells() {
    const { fleet } = this;
    const { rows, columns } = fleet.map;
    if (this.cells.length !== 4 * rows * columns) this.cells = new Uint8Array(4 * rows * columns);
    else this.cells.fill(0);
    const set = (cell, kind) => { if (4 * cell < this.cells.length) this.cells[4 * cell] = kind; };
    const past = this.replay;
    for (const cell of past?.blocked ?? fleet.blocked) set(cell, CELL.blocked);
    for (const cell of past?.pending ?? fleet.pending) set(cell, CELL.pending);
    for (const cell of fleet.walls) set(cell, CELL.wall);
    if (this.shown.congestion) this.#makeCongestion();
    if (this.shown.zones) {
      this.zones.forEach((zone, index) => { for (const cell of zone.cells ?? []) this.cells[4 * cell + 2] = 1 + (index % 6); });
    }
    this.cellsVersion++;
  }

  // How many planned paths lead over each cell; a robot that waits in one counts for three.
  #makeCongestion() {
    for (const robot of this.shownRobots.values()) {
      for (const cell of robot.plan) this.#heat(cell, 18);
      if (robot.state === "waiting" && robot.cell !== null) this.#heat(robot.cell, 54);
    }
  }

  #heat(cell, amount) {
    const place = 4 * cell + 1;
    if (place < this.cells.length) this.cells[place] = Math.min(255, this.cells[place] + amount);
  }

  // accent: the colour of goals that are not a robot's own.
  makeLines() {
    const robots = this.shownRobots;
    this.frame = this.fleet.frame;
    this.lineCount = 0;
    const { paths, trails, goals } = this.shown;
    const few = robots.size <= MANY;
    const pale = robots.size >= CROWD ? 0.3 : 1;
    for (const robot of robots.values()) {
      const chosen = robot.id === this.fleet.selected;
      const colour = paintOf(robot);
      if (trails === "all" || chosen || (trails === "few" && few)) this.#addTrail(robot, colour, few || chosen);
      if (paths === "all" || (paths === "selected" && chosen)) this.#addPath(robot, colour, chosen, pale);
      if (goals && robot.goal !== null && robot.goal !== undefined) this.#addGoal(robot.goal, colour, chosen, pale);
    }
    for (const { points, colour, width = 2, dash = 0 } of this.extra) {
      for (let index = 1; index < points.length; index++) this.#add(...points[index - 1], ...points[index], packed(colour), 1, width, dash);
    }
    this.linesVersion++;
  }

  #addTrail({ trail }, colour, whole) {
    if (!trail || trail.length < 2) return;
    const first = whole ? 0 : Math.max(0, trail.length - TRAIL_OF_MANY);
    let [x, y] = [trail.x(first), trail.y(first)];
    for (let index = first + 1; index < trail.length; index++) {
      const [nextX, nextY] = [trail.x(index), trail.y(index)];
      if (index + 1 < trail.length && isStraight(x, y, nextX, nextY, trail.x(index + 1), trail.y(index + 1))) continue;
      this.#add(x, y, nextX, nextY, colour, 0.35, 1.5, 0);
      x = nextX;
      y = nextY;
    }
  }

  // Granted cells (the base) are solid, the rest of the plan (the horizon) is dashed.
  #addPath(robot, colour, chosen, pale) {
    const { plan, granted } = robot;
    this.#addCells(plan, Math.max(0, granted.length - 1), plan.length - 1, colour, chosen ? 1 : 0.67 * pale, chosen ? 3 : 1.5, 1);
    this.#addCells(granted, 0, granted.length - 1, colour, 1, chosen ? 5 : pale < 1 ? 2 : 3, 0);
  }

  #addCells(cells, first, last, colour, alpha, width, dash) {
    const { frame } = this;
    let start = cells[first];
    for (let index = first + 1; index <= last; index++) {
      const cell = cells[index];
      if (index < last && cells[index + 1] - cell === cell - cells[index - 1]) continue;
      this.#add(frame.x(start), frame.y(start), frame.x(cell), frame.y(cell), colour, alpha, width, dash);
      start = cell;
    }
  }

  #addGoal(cell, colour, chosen, pale) {
    const [x, y] = [this.frame.x(cell), this.frame.y(cell)];
    const half = 0.17 * this.fleet.map.cell_size;
    const width = chosen ? 3 : 2;
    const alpha = chosen ? 1 : pale;
    this.#add(x - half, y - half, x + half, y - half, colour, alpha, width, 0);
    this.#add(x + half, y - half, x + half, y + half, colour, alpha, width, 0);
    this.#add(x + half, y + half, x - half, y + half, colour, alpha, width, 0);
    this.#add(x - half, y + half, x - half, y - half, colour, alpha, width, 0);
  }

  #add(x0, y0, x1, y1, colour, alpha, width, dash) {
    const at = this.lineCount++ * LINE;
    if (at + LINE > this.lines.length) this.lines = roomFor(this.lines, this.lineCount, LINE_TEXELS);
    const { lines } = this;
    lines[at] = x0;
    lines[at + 1] = y0;
    lines[at + 2] = x1;
    lines[at + 3] = y1;
    lines[at + 4] = colour;
    lines[at + 5] = alpha;
    lines[at + 6] = width;
    lines[at + 7] = dash;
  }

  // Move the robots towards their newest poses; return whether one still moves. seconds: since the frame before.
  // Runs for each robot and frame: it makes no objects.
  moveRobots(seconds) {
    const shownRobots = this.shownRobots;
    const share = 1 - Math.exp(-seconds / SMOOTH_S);
    if (this.robots.length < shownRobots.size * ROBOT) this.robots = roomFor(this.robots, shownRobots.size, ROBOT_TEXELS);
    const { robots } = this;
    const { selected } = this.fleet;
    let at = 0;
    let moving = false;
    for (const robot of shownRobots.values()) {
      const { pose } = robot;
      if (!pose) continue;
      const shown = (robot.shown ??= { ...pose });
      const right = pose.x - shown.x;
      const up = pose.y - shown.y;
      let turn = pose.theta - shown.theta;
      turn -= 2 * Math.PI * Math.round(turn / (2 * Math.PI));
      const distance = Math.abs(right) + Math.abs(up);
      if (distance + Math.abs(turn) < STILL || distance > JUMP_M) {
        shown.x = pose.x;
        shown.y = pose.y;
        shown.theta = pose.theta;
      } else {
        shown.x += right * share;
        shown.y += up * share;
        shown.theta += turn * share;
        moving = true;
      }
      robots[at] = shown.x;
      robots[at + 1] = shown.y;
      robots[at + 2] = shown.theta;
      robots[at + 3] = (robot.id === selected ? LOOK.selected : 0) + LOOK.mark * markOf(robot) + (robot.loads ? LOOK.loaded : 0);
      robots[at + 4] = paintOf(robot);
      at += ROBOT;
    }
    this.robotCount = at / ROBOT;
    return moving;
  }
}

// A robot's colour as one number; kept, because it is needed for each frame.
export function paintOf(robot) {
  return (robot.paint ??= packed(rgbOf(robot.id)));
}

// Whether a trail goes straight on, to about 2 cm.
function isStraight(x0, y0, x1, y1, x2, y2) {
  const length = Math.hypot(x2 - x0, y2 - y0);
  if (length < 1e-6) return false;
  return Math.abs((x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)) < 0.02 * length && (x1 - x0) * (x2 - x1) + (y1 - y0) * (y2 - y1) > 0;
}
