// The page's model of the fleet, updated by messages of the station's WebSocket; independent of the screen.
// The station sends the complete state first (map, state, poses), then numbered changes.

export const TRAIL_LENGTH = 240;

export class Fleet extends EventTarget {
  map = null;          // {rows, columns, cell_size, origin: [x, y], yaw, robot_radius, walls}; row 0 is the lowest
  robots = new Map();  // id -> {id, state, reason, cell, goal, plan, granted, replans, pose, seen, trail}
  walls = new Set();   // blocked cells that belong to the map
  blocked = new Set();
  pending = new Set();
  engine = null;
  selected = null;
  sequence = 0;        // number of the last change that is known
  isBehind = false;    // a change is missing: everything is needed again

  apply(message) {
    const handler = this[`on_${message.type}`];
    if (handler) {
      handler.call(this, message);
      this.dispatchEvent(new Event(message.type));
    }
  }

  on_map(message) {
    this.map = message;
    this.walls = new Set(message.walls);
  }

  on_state(message) {
    this.sequence = message.sequence;
    this.isBehind = false;
    for (const [text, tone] of this.#cellNews(message)) this.#tell(text, tone);
    for (const [text, tone] of this.#robotNews(message.robots)) this.#tell(text, tone);
    this.blocked = new Set(message.blocked);
    this.pending = new Set(message.pending);
    const present = new Set();
    for (const state of message.robots) {
      present.add(state.id);
      Object.assign(this.#robot(state.id), state);
    }
    for (const id of this.robots.keys()) {
      if (!present.has(id)) this.#remove(id);
    }
  }

  on_changes(message) {
    this.isBehind ||= message.sequence !== this.sequence + 1;
    if (this.isBehind) return;
    this.sequence = message.sequence;
    for (const cell of message.blocked) if (!this.blocked.has(cell)) this.#tell(`cell ${cell} is blocked`, "warn");
    for (const cell of message.freed) if (this.blocked.has(cell)) this.#tell(`cell ${cell} is free`, "good");
    for (const [text, tone] of this.#robotNews(message.robots)) this.#tell(text, tone);
    for (const cell of [...message.pending, ...message.freed]) this.blocked.delete(cell);
    for (const cell of [...message.blocked, ...message.freed]) this.pending.delete(cell);
    for (const cell of message.blocked) this.blocked.add(cell);
    for (const cell of message.pending) this.pending.add(cell);
    for (const state of message.robots) Object.assign(this.#robot(state.id), state);
    for (const id of message.removed) this.#remove(id);
  }

  #remove(id) {
    this.robots.delete(id);
    if (this.selected === id) this.selected = null;
  }

  on_poses(message) {
    for (const [id, [x, y, theta]] of Object.entries(message.poses)) {
      const robot = this.#robot(id);
      robot.pose = { x, y, theta };
      robot.shown ??= { x, y, theta };
      robot.seen = performance.now();
      const last = robot.trail.at(-1);
      if (!last || Math.hypot(last[0] - x, last[1] - y) > 0.05) {
        robot.trail.push([x, y]);
        if (robot.trail.length > TRAIL_LENGTH) robot.trail.shift();
      }
    }
  }

  on_engine(message) {
    this.engine = message;
  }

  on_event(message) {
    this.#tell(message.text, message.tone);
  }

  // Events for the operator from the cells of a complete state.
  *#cellNews(message) {
    if (!this.blocked.size) return;
    for (const cell of message.blocked) if (!this.blocked.has(cell)) yield [`cell ${cell} is blocked`, "warn"];
    const left = new Set([...message.blocked, ...message.pending]);
    for (const cell of this.blocked) if (!left.has(cell)) yield [`cell ${cell} is free`, "good"];
  }

  // Events for the operator from robots that changed.
  *#robotNews(robots) {
    for (const state of robots) {
      const before = this.robots.get(state.id);
      if (!before) continue;
      if (state.replans > before.replans) yield [`${state.id} gets a new path`, "warn"];
      if (state.state === before.state) continue;
      if (state.state === "arrived") yield [`${state.id} is at its goal, cell ${state.goal}`, "good"];
      if (state.state === "unreachable") yield [`no path leads ${state.id} to cell ${state.goal}`, "bad"];
      if (state.state === "silent") yield [`${state.id} is silent: ${state.reason}`, "bad"];
      if (before.state === "silent") yield [`${state.id} sends messages again`, "good"];
    }
  }

  #tell(text, tone = "") {
    this.dispatchEvent(new CustomEvent("news", { detail: { text, tone } }));
  }

  select(id) {
    this.selected = this.selected === id ? null : id;
    this.dispatchEvent(new Event("selected"));
  }

  robotAt(x, y, radius) {
    let best = null;
    let nearest = radius;
    for (const robot of this.robots.values()) {
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
      this.robots.set(id, { id, state: "unknown", reason: "", cell: null, goal: null, plan: [], granted: [], replans: 0, pose: null, shown: null, seen: null, trail: [] });
    }
    return this.robots.get(id);
  }
}

// A fixed colour for each robot: chosen ones for the first, then hues spread by the golden angle.
const COLOURS = ["#2a7de1", "#d9480f", "#0f9d76", "#9c36b5", "#c2255c", "#5f7d0e", "#0b7285", "#7048e8"];

export function colourOf(id) {
  const number = Number(id.replace(/\D+/g, "")) || [...id].reduce((sum, c) => sum + c.charCodeAt(0), 0);
  return COLOURS[number - 1] ?? `hsl(${(205 + number * 137.508) % 360} 65% 48%)`;
}
