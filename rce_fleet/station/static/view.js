// Draws the world on a canvas: cells, boxes, plans, trails, robots. World metres, y up; the screen's y points down.

import { LayerView } from "./layer_view.js";
import { colourOf } from "./model.js";

const MARGIN = 0.15;    // of a cell, around the map
const BOX = 0.6;        // edge of a box, of a cell
const SMOOTHING = 0.25; // share of the way to the newest pose that a robot is moved in one frame

export class View {
  cursor = null; // cell under the pointer or the keyboard
  editor = null; // has the grid that may be taken over

  constructor(canvas, fleet, layers) {
    this.canvas = canvas;
    this.fleet = fleet;
    this.layers = new LayerView(layers);
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.#resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#readColours());
    this.#readColours();
    this.#resize();
    const frame = () => { this.draw(); requestAnimationFrame(frame); };
    requestAnimationFrame(frame);
  }

  worldAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const ratio = this.canvas.width / box.width;
    return [
      ((event.clientX - box.left) * ratio - this.left) / this.scale,
      (this.bottom - (event.clientY - box.top) * ratio) / this.scale,
    ];
  }

  // Where the middle of a cell is on the page, in CSS pixels from the canvas' corner.
  screenOf(cell) {
    const [x, y] = this.fleet.centre(cell);
    const ratio = this.canvas.width / this.canvas.getBoundingClientRect().width;
    return [(this.left + x * this.scale) / ratio, (this.bottom - y * this.scale) / ratio];
  }

  #readColours() {
    const style = getComputedStyle(document.documentElement);
    this.colour = Object.fromEntries(
      ["cell", "line", "wall", "box", "boxedge", "shut", "pending", "ink", "quiet", "accent", "bad"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]),
    );
    this.layers.readColours(style);
  }

  #resize() {
    const ratio = window.devicePixelRatio || 1;
    const box = this.canvas.getBoundingClientRect();
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
  }

  #fit() {
    const [x0, y0, x1, y1] = this.fleet.bounds(this.editor?.proposed);
    const margin = MARGIN * this.fleet.map.cell_size;
    const width = x1 - x0 + 2 * margin;
    const height = y1 - y0 + 2 * margin;
    this.scale = Math.min(this.canvas.width / width, this.canvas.height / height);
    this.left = (this.canvas.width - width * this.scale) / 2 + (margin - x0) * this.scale;
    this.bottom = (this.canvas.height + height * this.scale) / 2 - (margin - y0) * this.scale;
  }

  #x(x) { return this.left + x * this.scale; }
  #y(y) { return this.bottom - y * this.scale; }

  draw() {
    const { context, canvas, fleet } = this;
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (!fleet.map) return;
    this.#fit();
    this.layers.drawBelow(this);
    if (this.layers.layers.grid) this.#drawCells();
    this.#drawCursor();
    if (this.editor?.proposed) this.#drawProposed(this.editor.proposed);
    for (const robot of fleet.robots.values()) this.#drawTrail(robot);
    for (const robot of fleet.robots.values()) this.#drawPlan(robot);
    for (const robot of fleet.robots.values()) this.#drawRobot(robot);
    this.layers.drawAbove(this);
  }

  // Go to the grid: the first cell begins at the origin; its columns go right and its rows up (negative).
  #enterGrid(grid = this.fleet.map) {
    const { context } = this;
    const [x, y] = grid.origin;
    context.save();
    context.translate(this.#x(x), this.#y(y));
    context.rotate(-(grid.yaw ?? 0));
  }

  // The grid that may be taken over: dashed lines, blocked cells crossed out.
  #drawProposed(grid) {
    const { context, colour } = this;
    const side = grid.cell_size * this.scale;
    this.#enterGrid(grid);
    context.strokeStyle = colour.accent;
    context.lineWidth = Math.max(1, devicePixelRatio);
    context.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
    context.beginPath();
    for (let row = 0; row <= grid.rows; row++) {
      context.moveTo(0, -row * side);
      context.lineTo(grid.columns * side, -row * side);
    }
    for (let column = 0; column <= grid.columns; column++) {
      context.moveTo(column * side, 0);
      context.lineTo(column * side, -grid.rows * side);
    }
    context.stroke();
    context.setLineDash([]);
    context.beginPath();
    for (const cell of grid.walls) {
      const [left, top] = [(cell % grid.columns) * side, -(Math.floor(cell / grid.columns) + 1) * side];
      context.moveTo(left, top);
      context.lineTo(left + side, top + side);
      context.moveTo(left + side, top);
      context.lineTo(left, top + side);
    }
    context.stroke();
    context.restore();
  }

  #drawCells() {
    const { context, fleet, colour } = this;
    const { rows, columns } = fleet.map;
    this.#enterGrid();
    const overMap = this.layers.hasMap;
    const side = fleet.map.cell_size * this.scale;
    const small = side < 24;
    const gap = small ? 0 : Math.max(1, side * 0.02);
    context.font = `${Math.round(side * 0.16)}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "top";
    for (let cell = 0; cell < rows * columns; cell++) {
      const left = (cell % columns) * side + gap;
      const top = -(Math.floor(cell / columns) + 1) * side + gap;
      const wall = fleet.walls.has(cell);
      const boxed = !wall && fleet.blocked.has(cell);
      context.fillStyle = wall ? colour.wall : boxed ? colour.shut : fleet.pending.has(cell) ? colour.pending : colour.cell;
      // Over the map, cells are outlined, so that it can be seen through them.
      if (overMap) {
        context.globalAlpha = 0.35;
        if (wall || boxed || fleet.pending.has(cell)) context.fillRect(left, top, side - 2 * gap, side - 2 * gap);
        context.globalAlpha = 1;
        context.strokeStyle = colour.line;
        context.lineWidth = 1;
        context.strokeRect(left, top, side - 2 * gap, side - 2 * gap);
      } else if (wall) context.fillRect(left - gap - 0.5, top - gap - 0.5, side + 1, side + 1);
      else context.fillRect(left, top, side - 2 * gap, side - 2 * gap);
      if (boxed) this.#drawBox(left - gap + side / 2, top - gap + side / 2, BOX * side);
      if (!small && !wall) {
        context.fillStyle = colour.quiet;
        context.fillText(cell, left + side * 0.05, top + side * 0.05);
      }
    }
    context.restore();
  }

  #drawCursor() {
    if (this.cursor === null) return;
    const { context, fleet } = this;
    const side = fleet.map.cell_size * this.scale;
    const gap = side < 24 ? 0 : Math.max(1, side * 0.02);
    const [left, top] = [(this.cursor % fleet.map.columns) * side, -(Math.floor(this.cursor / fleet.map.columns) + 1) * side];
    this.#enterGrid();
    context.strokeStyle = this.colour.accent;
    context.lineWidth = Math.max(2, side * 0.04);
    context.strokeRect(left + gap, top + gap, side - 2 * gap, side - 2 * gap);
    context.restore();
  }

  #drawBox(x, y, side) {
    const { context, colour } = this;
    const half = side / 2;
    context.fillStyle = colour.box;
    context.fillRect(x - half, y - half, side, side);
    context.strokeStyle = colour.boxedge;
    context.lineWidth = Math.max(1, side * 0.06);
    context.strokeRect(x - half, y - half, side, side);
    context.beginPath();
    context.moveTo(x - half, y - half);
    context.lineTo(x + half, y + half);
    context.moveTo(x + half, y - half);
    context.lineTo(x - half, y + half);
    context.stroke();
  }

  #line(points) {
    const { context } = this;
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(this.#x(x), this.#y(y)) : context.moveTo(this.#x(x), this.#y(y))));
    context.stroke();
  }

  #drawTrail(robot) {
    if (robot.trail.length < 2) return;
    const { context } = this;
    context.strokeStyle = colourOf(robot.id);
    context.globalAlpha = 0.35;
    context.lineWidth = Math.max(1, 0.03 * this.scale);
    this.#line(robot.trail);
    context.globalAlpha = 1;
  }

  #drawPlan(robot) {
    const { context, fleet } = this;
    context.strokeStyle = context.fillStyle = colourOf(robot.id);
    context.lineWidth = Math.max(2, 0.06 * this.scale);
    context.lineCap = context.lineJoin = "round";
    if (robot.plan.length > 1) {
      context.setLineDash([0.12 * this.scale, 0.14 * this.scale]);
      this.#line(robot.plan.map((cell) => fleet.centre(cell)));
      context.setLineDash([]);
    }
    if (robot.granted.length > 1) this.#line(robot.granted.map((cell) => fleet.centre(cell)));
    if (robot.goal !== null) {
      const [x, y] = fleet.centre(robot.goal);
      const half = 0.16 * fleet.map.cell_size * this.scale;
      context.strokeRect(this.#x(x) - half, this.#y(y) - half, 2 * half, 2 * half);
    }
  }

  #drawRobot(robot) {
    if (!robot.pose) return;
    const { context, fleet } = this;
    const { pose, shown } = robot;
    shown.x += (pose.x - shown.x) * SMOOTHING;
    shown.y += (pose.y - shown.y) * SMOOTHING;
    shown.theta += Math.atan2(Math.sin(pose.theta - shown.theta), Math.cos(pose.theta - shown.theta)) * SMOOTHING;
    const radius = (fleet.map.robot_radius ?? 0.25) * this.scale;
    context.save();
    context.translate(this.#x(shown.x), this.#y(shown.y));
    context.fillStyle = colourOf(robot.id);
    context.beginPath();
    context.arc(0, 0, radius, 0, 2 * Math.PI);
    context.fill();
    if (robot.id === fleet.selected) {
      context.strokeStyle = this.colour.ink;
      context.lineWidth = Math.max(2, radius * 0.16);
      context.stroke();
    }
    context.rotate(-shown.theta);
    context.fillStyle = "#fff";
    context.beginPath();
    context.moveTo(radius * 0.85, 0);
    context.lineTo(-radius * 0.2, radius * 0.5);
    context.lineTo(-radius * 0.2, -radius * 0.5);
    context.fill();
    context.restore();
    if (this.scale * fleet.map.cell_size > 40) {
      context.font = `600 ${Math.round(radius * 0.75)}px system-ui, sans-serif`;
      context.textAlign = "center";
      context.textBaseline = "bottom";
      context.fillStyle = this.colour.ink;
      context.fillText(robot.id, this.#x(shown.x), this.#y(shown.y) - radius * 1.1);
    }
  }
}
