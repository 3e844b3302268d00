// What is drawn over the fleet: numbers of cells, names of robots, layers of one robot, the cursor, tools at work.

const CELL_NUMBER_PX = 34;  // side of a cell, CSS pixels, from which its number is shown
const NAME_PX = 30;         // the same for names of robots
const MOST_NAMES = 150;
const ARROW_EVERY = 4;      // cells between two arrowheads of a one-way lane

export class Overlay {
  preview = null;   // what a tool is about to do: draws itself with (context, camera, colour), and returns whether it drew
  hasNames = false;
  #isEmpty = false;

  constructor(view) {
    this.view = view;
    this.context = view.canvas.getContext("2d");
  }

  // An overlay that stays empty is not touched: the browser then does not put the page together again.
  draw() {
    const { context, view } = this;
    if (!this.#isEmpty) context.clearRect(0, 0, view.canvas.width, view.canvas.height);
    const side = (view.fleet.map.cell_size * view.scale) / devicePixelRatio;
    const lanes = view.scene.shown.lanes ? view.fleet.map.lanes ?? [] : [];
    if (lanes.length) this.#drawLanes(lanes);
    const hasNumbers = side >= CELL_NUMBER_PX && view.layers.layers.grid;
    if (hasNumbers) this.#drawNumbers();
    this.#drawCursor();
    const proposed = view.editor?.proposed;
    if (proposed) this.#drawProposed(proposed);
    view.drawLayersAbove(context);
    this.#drawNames(side);
    const hasPreview = this.preview?.(context, view.camera, view.colour);
    const { shown } = view.layers.layers;
    this.#isEmpty = !lanes.length && !hasNumbers && view.cursor === null && !proposed && !shown.size && !this.hasNames && !hasPreview;
  }

  // Go to a grid: the first cell begins at the origin; its columns go right and its rows up (negative).
  #enterGrid(grid = this.view.fleet.map) {
    const [x, y] = grid.origin;
    this.context.save();
    this.context.translate(this.view.camera.x(x), this.view.camera.y(y));
    this.context.rotate(-(grid.yaw ?? 0));
  }

  // Cells that may be on the screen: a rectangle of the grid around the screen's corners.
  *#visibleCells() {
    const { fleet, camera } = this.view;
    const { rows, columns, cell_size, origin, yaw = 0 } = fleet.map;
    const corners = [[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]].map((corner) => {
      const [x, y] = camera.worldAt(...corner);
      const [right, up] = [x - origin[0], y - origin[1]];
      return [(right * Math.cos(yaw) + up * Math.sin(yaw)) / cell_size, (up * Math.cos(yaw) - right * Math.sin(yaw)) / cell_size];
    });
    const reach = (part, most) => [Math.max(0, Math.floor(Math.min(...corners.map((corner) => corner[part])))), Math.min(most, Math.ceil(Math.max(...corners.map((corner) => corner[part]))))];
    const [[left, right], [low, high]] = [reach(0, columns), reach(1, rows)];
    for (let row = low; row < high; row++) for (let column = left; column < right; column++) yield row * columns + column;
  }

  #drawNumbers() {
    const { context, view } = this;
    const { columns, cell_size } = view.fleet.map;
    const side = cell_size * view.scale;
    this.#enterGrid();
    context.font = `${Math.round(side * 0.16)}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillStyle = view.colour.quiet;
    for (const cell of this.#visibleCells()) {
      if (view.fleet.walls.has(cell)) continue;
      context.fillText(cell, (cell % columns) * side + side * 0.05, -(Math.floor(cell / columns) + 1) * side + side * 0.05);
    }
    context.restore();
  }

  // Lanes: a line through the middle of their cells, with arrowheads where they have one direction.
  #drawLanes(lanes) {
    const { context, view } = this;
    const { columns, cell_size } = view.fleet.map;
    const side = cell_size * view.scale;
    const middle = (cell) => [((cell % columns) + 0.5) * side, -(Math.floor(cell / columns) + 0.5) * side];
    this.#enterGrid();
    context.strokeStyle = context.fillStyle = view.colour.quiet;
    context.globalAlpha = 0.6; // they lie over the robots
    context.lineWidth = Math.max(1, side * 0.03);
    context.lineJoin = "round";
    context.beginPath();
    for (const { cells } of lanes) cells.forEach((cell, index) => (index ? context.lineTo(...middle(cell)) : context.moveTo(...middle(cell))));
    context.stroke();
    context.beginPath();
    const reach = side * 0.16;
    for (const { cells, one_way } of lanes) {
      if (!one_way) continue;
      for (let index = 0; index + 1 < cells.length; index += ARROW_EVERY) {
        const [[x, y], [toX, toY]] = [middle(cells[index]), middle(cells[index + 1])];
        const [right, down] = [(toX - x) / side, (toY - y) / side];
        const [tipX, tipY] = [(x + toX) / 2 + right * reach, (y + toY) / 2 + down * reach];
        context.moveTo(tipX, tipY);
        for (const across of [-1, 1]) context.lineTo(tipX - (2 * right + across * down) * reach, tipY - (2 * down - across * right) * reach);
        context.closePath();
      }
    }
    context.fill();
    context.restore();
  }

  // Names of robots that are on the screen, if there is room; the selected robot's always.
  #drawNames(side) {
    const { context, view } = this;
    const { camera, fleet, scene } = view;
    const radius = (fleet.map.robot_radius ?? 0.25) * camera.scale;
    const size = Math.max(11 * devicePixelRatio, Math.min(radius * 0.75, 22 * devicePixelRatio));
    context.font = `600 ${Math.round(size)}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "bottom";
    context.lineJoin = "round";
    let drawn = 0;
    for (const robot of scene.shownRobots.values()) {
      const chosen = robot.id === fleet.selected;
      if (!robot.shown || (!chosen && side < NAME_PX)) continue;
      const [x, y] = [camera.x(robot.shown.x), camera.y(robot.shown.y)];
      if (x < 0 || y < 0 || x > camera.width || y > camera.height || (drawn++ > MOST_NAMES && !chosen)) continue;
      context.strokeStyle = view.colour.cell;
      context.lineWidth = 3 * devicePixelRatio;
      context.strokeText(robot.id, x, y - radius * 1.1);
      context.fillStyle = view.colour.ink;
      context.fillText(robot.id, x, y - radius * 1.1);
    }
    this.hasNames = drawn > 0;
  }

  #drawCursor() {
    const { context, view } = this;
    if (view.cursor === null) return;
    const { columns, cell_size } = view.fleet.map;
    const side = cell_size * view.scale;
    const gap = side < 24 ? 0 : Math.max(1, side * 0.02);
    this.#enterGrid();
    context.strokeStyle = view.colour.accent;
    context.lineWidth = Math.max(2, side * 0.04);
    context.strokeRect((view.cursor % columns) * side + gap, -(Math.floor(view.cursor / columns) + 1) * side + gap, side - 2 * gap, side - 2 * gap);
    context.restore();
  }

  // The grid that may be taken over: dashed lines, blocked cells crossed out.
  #drawProposed(grid) {
    const { context, view } = this;
    const side = grid.cell_size * view.scale;
    this.#enterGrid(grid);
    context.strokeStyle = view.colour.accent;
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
}
