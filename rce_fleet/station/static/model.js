// The page's model of the fleet, updated by messages of the station's WebSocket; independent of the screen.
// The station sends the complete state first (map, state, poses), then numbered changes.

import { t } from "./texts.js";
import { Trail } from "./trail.js";

const FRAME = 0x50454352;   // "RCEP", as the number at the start of a frame of poses
const FRAME_HEADER = 16;
const ROW_BYTES = 20;
const SEEN = 0.003;         // metres and radians; less is noise of a robot that stands

// How far apart two poses are, metres and radians together.
function difference(right, up, turn) {
  return Math.abs(right) + Math.abs(up) + Math.abs(turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI)));
}

export class Fleet extends EventTarget {
  map = null;          // {rows, columns, cell_size, origin: [x, y], yaw, robot_radius, walls, lanes}; row 0 is the lowest
  robots = new Map();  // id -> {id, state, reason, cell, goal, plan, granted, replans, pose, seen, trail}
  walls = new Set();   // blocked cells that belong to the map
  blocked = new Set();
  pending = new Set();
  blocks = new Map();  // cell -> {cell, user, robot, reason, since, until} of cells that people or sensors blocked
  engine = null;
  masters = null;      // which of several leads; null: there is one
  selected = null;
  hasMoved = false;    // whether something moved with the newest poses or models
  models = [];         // of a simulated world: [name, x, y, yaw]
  things = {};         // what they are: {name: ["robot" or "light"], ["box", width, depth] or ["walker", radius]}
  isPaused = false;    // whether the time of the simulated world stands still
  mode = "automatic";  // of the whole fleet: automatic, paused or stopped
  stopped = {};        // robot -> who stopped it
  undelivered = new Set(); // robots of these that have not got the stop yet
  stoppedBy = null;    // who stopped all robots, also those that appear later
  driven = {};         // robot -> who drives it by hand
  plannerAwaySince = null; // seconds since 1970; null: the planner is there
  manager = false;     // whether a fleet manager answers
  sequence = 0;        // number of the last change that is known
  isBehind = false;    // a change is missing: everything is needed again
  #byIndex = [];       // robots by their index in frames

  apply(message) {
    const handler = this[`on_${message.type}`];
    if (handler) {
      handler.call(this, message);
      if (message.type !== "audit") this.dispatchEvent(new Event(message.type));
    }
  }

  on_map(message) {
    this.map = message;
    this.walls = new Set(message.walls);
  }

  on_state(message) {
    this.sequence = message.sequence;
    this.mode = message.mode;
    this.isBehind = false;
    for (const [text, tone] of this.#cellNews(message)) this.#tell(text, tone);
    for (const [text, tone] of this.#robotNews(message.robots)) this.#tell(text, tone);
    this.blocked = new Set(message.blocked);
    this.pending = new Set(message.pending);
    this.blocks = new Map((message.blocks ?? []).map((block) => [block.cell, block]));
    const present = new Set();
    for (const state of message.robots) {
      present.add(state.id);
      this.#take(state);
    }
    for (const id of this.robots.keys()) {
      if (!present.has(id)) this.#remove(id);
    }
  }

  on_changes(message) {
    this.isBehind ||= message.sequence !== this.sequence + 1;
    if (this.isBehind) return;
    this.sequence = message.sequence;
    this.mode = message.mode;
    for (const cell of message.blocked) if (!this.blocked.has(cell)) this.#tell(t("news.blocked", { cell }), "warn");
    for (const cell of message.freed) if (this.blocked.has(cell)) this.#tell(t("news.free", { cell }), "good");
    for (const [text, tone] of this.#robotNews(message.robots)) this.#tell(text, tone);
    for (const cell of [...message.pending, ...message.freed]) this.blocked.delete(cell);
    for (const cell of [...message.blocked, ...message.freed]) this.pending.delete(cell);
    for (const cell of message.blocked) this.blocked.add(cell);
    for (const cell of message.pending) this.pending.add(cell);
    for (const cell of message.removed_blocks ?? []) this.blocks.delete(cell);
    for (const block of message.blocks ?? []) this.blocks.set(block.cell, block);
    for (const state of message.robots) this.#take(state);
    for (const id of message.removed) this.#remove(id);
    if (message.blocked.length || message.pending.length || message.freed.length) this.dispatchEvent(new Event("cells"));
  }

  #take(state) {
    const robot = this.#robot(state.id);
    if (state.state !== "waiting") robot.waitingSince = null;
    else if (robot.state !== "waiting") robot.waitingSince = performance.now(); // on_waiting corrects those that waited before
    Object.assign(robot, state);
    if (state.index !== undefined) this.#byIndex[state.index] = robot;
  }

  #remove(id) {
    const robot = this.robots.get(id);
    if (robot?.index !== undefined) delete this.#byIndex[robot.index];
    this.robots.delete(id);
    if (this.selected === id) this.selected = null;
  }

  on_poses(message) {
    this.hasMoved = false;
    for (const [id, [x, y, theta]] of Object.entries(message.poses)) this.#move(this.#robot(id), x, y, theta, performance.now());
  }

  // Whether a binary message is a frame of poses; rce_fleet.station.pose_frames describes them.
  static isFrame(buffer) {
    return buffer.byteLength >= FRAME_HEADER && new DataView(buffer).getUint32(0, true) === FRAME;
  }

  applyFrame(buffer) {
    // Little-endian, as all machines are that run browsers.
    const whole = new Uint32Array(buffer);
    const parts = new Float32Array(buffer);
    const end = Math.min(whole.length, (FRAME_HEADER + whole[1] * ROW_BYTES) / 4);
    const now = performance.now();
    this.hasMoved = false;
    for (let at = FRAME_HEADER / 4; at < end; at += ROW_BYTES / 4) {
      const robot = this.#byIndex[whole[at]];
      if (!robot) continue;
      this.#move(robot, parts[at + 1], parts[at + 2], parts[at + 3], now);
      if (parts[at + 4] >= 0) robot.heard = now - 1000 * parts[at + 4];
    }
    this.dispatchEvent(new Event("poses"));
  }

  #move(robot, x, y, theta, now) {
    const { pose } = robot;
    robot.seen = now;
    if (pose && difference(x - pose.x, y - pose.y, theta - pose.theta) < SEEN) return;
    this.hasMoved = true;
    if (pose) {
      pose.x = x;
      pose.y = y;
      pose.theta = theta;
    } else robot.pose = { x, y, theta };
    robot.shown ??= { x, y, theta };
    robot.trail.add(x, y);
  }

  // For how many seconds robots have waited, also before this page was opened.
  on_waiting({ seconds }) {
    const now = performance.now();
    for (const [id, waited] of Object.entries(seconds)) {
      const robot = this.robots.get(id);
      if (robot?.state === "waiting") robot.waitingSince = now - 1000 * waited;
    }
  }

  // Who stopped robots, and who drives them by hand: {robot: user}.
  on_control({ stopped, driven, fleet_stopped_by: stoppedBy, undelivered }) {
    this.stopped = stopped;
    this.undelivered = new Set(undelivered);
    this.stoppedBy = stoppedBy ?? null;
    this.driven = driven;
    for (const robot of this.robots.values()) Object.assign(robot, this.#control(robot.id));
  }

  #control(id) {
    return { emergency: this.stopped[id] ?? null, undelivered: this.undelivered.has(id), driver: this.driven[id] ?? null };
  }

  // Robots that have not got their stop, and that the planner does not know.
  unknownUndelivered() {
    return [...this.undelivered].filter((id) => !this.robots.has(id)).map((id) => ({ id, state: "unknown", ...this.#control(id) }));
  }

  on_manager({ here }) {
    this.manager = here;
  }

  on_planner({ away_since: awaySince }) {
    this.plannerAwaySince = awaySince;
  }

  on_masters(message) {
    this.masters = message;
  }

  on_engine(message) {
    this.engine = message;
  }

  // The truth of a simulated world: [name, x, y, yaw].
  on_world({ models }) {
    const before = this.models;
    const isSame = ([name, x, y, yaw], [other, x0, y0, yaw0]) => name === other && difference(x - x0, y - y0, yaw - yaw0) < SEEN;
    this.hasMoved = models.length !== before.length || !models.every((model, place) => isSame(model, before[place]));
    if (this.hasMoved) this.models = models;
  }

  on_things({ things, paused }) {
    this.things = things;
    this.isPaused = paused;
  }

  on_audit(message) {
    this.dispatchEvent(new CustomEvent("audit", { detail: message }));
  }

  on_event(message) {
    this.#tell(message.text, message.tone);
  }

  // Events for the operator from the cells of a complete state.
  *#cellNews(message) {
    if (!this.blocked.size) return;
    for (const cell of message.blocked) if (!this.blocked.has(cell)) yield [t("news.blocked", { cell }), "warn"];
    const left = new Set([...message.blocked, ...message.pending]);
    for (const cell of this.blocked) if (!left.has(cell)) yield [t("news.free", { cell }), "good"];
  }

  // Events for the operator from robots that changed.
  *#robotNews(robots) {
    for (const state of robots) {
      const before = this.robots.get(state.id);
      if (!before) continue;
      if (state.replans > before.replans) yield [t("news.replanned", { robot: state.id }), "warn"];
      if (state.state === before.state) continue;
      if (state.state === "arrived") yield [t("news.arrived", { robot: state.id, cell: state.goal }), "good"];
      if (state.state === "unreachable") yield [t("news.unreachable", { robot: state.id, cell: state.goal }), "bad"];
      if (state.state === "silent") yield [t("news.silent", { robot: state.id, reason: state.reason }), "bad"];
      if (before.state === "silent") yield [t("news.back", { robot: state.id }), "good"];
    }
  }

  #tell(text, tone = "") {
    this.dispatchEvent(new CustomEvent("news", { detail: { text, tone } }));
  }

  select(id) {
    this.selected = this.selected === id ? null : id;
    this.dispatchEvent(new Event("selected"));
  }

  // The nearest of robots, which may be those of a past moment.
  robotAt(x, y, radius, robots = this.robots) {
    let best = null;
    let nearest = radius;
    for (const robot of robots.values()) {
      if (!robot.pose) continue;
      const distance = Math.hypot(robot.pose.x - x, robot.pose.y - y);
      if (distance <= nearest) [best, nearest] = [robot, distance];
    }
    return best;
  }

  cellAt(x, y) {
    const { rows, columns, cell_size, origin, yaw = 0 } = this.map;
    const [right, up] = [x - origin[0], y - origin[1]];
    const column = Math.floor((right * Math.cos(yaw) + up * Math.sin(yaw)) / cell_size);
    const row = Math.floor((up * Math.cos(yaw) - right * Math.sin(yaw)) / cell_size);
    return column >= 0 && column < columns && row >= 0 && row < rows ? row * columns + column : null;
  }

  centre(cell) {
    const { columns } = this.map;
    return this.#place((cell % columns) + 0.5, Math.floor(cell / columns) + 0.5);
  }

  // The same without a pair for each cell: {x(cell), y(cell)}; for as long as the map is not replaced.
  get frame() {
    const { columns, cell_size, origin, yaw = 0 } = this.map;
    const [c, s] = [cell_size * Math.cos(yaw), cell_size * Math.sin(yaw)];
    const up = (cell) => Math.floor(cell / columns) + 0.5;
    return {
      x: (cell) => origin[0] + ((cell % columns) + 0.5) * c - up(cell) * s,
      y: (cell) => origin[1] + ((cell % columns) + 0.5) * s + up(cell) * c,
    };
  }

  // The rectangle around the fleet's grid, and another one: [least x, least y, greatest x, greatest y], metres.
  bounds(other = null) {
    const corners = [this.map, other].filter(Boolean).flatMap((grid) => {
      const { rows, columns } = grid;
      return [[0, 0], [columns, 0], [0, rows], [columns, rows]].map(([column, row]) => this.#place(column, row, grid));
    });
    const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }

  // The point of a column and row, which may be fractions, in the map frame.
  #place(column, row, grid = this.map) {
    const { cell_size, origin: [x, y], yaw = 0 } = grid;
    const [right, up] = [column * cell_size, row * cell_size];
    return [x + right * Math.cos(yaw) - up * Math.sin(yaw), y + right * Math.sin(yaw) + up * Math.cos(yaw)];
  }

  #robot(id) {
    if (!this.robots.has(id)) {
      this.robots.set(id, { id, state: "unknown", reason: "", cell: null, goal: null, plan: [], granted: [], replans: 0, pose: null, shown: null, seen: null, heard: null, trail: new Trail(), waitingSince: null, ...this.#control(id) });
    }
    return this.robots.get(id);
  }
}
