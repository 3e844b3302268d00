// Draws a scene on a canvas of two dimensions, for browsers without WebGL 2.

import { rgb } from "./colours.js";
import { MARK } from "./conditions.js";
import { CELL, LINE_TEXELS, LOOK, ROBOT_TEXELS } from "./scene.js";

const LEAST_ROBOT_PX = 3.2;
const SPRITE = 1.75;   // half a side of a robot's picture, of its radius
const BOX = 0.6; // edge of a box, of a cell
const SMALL_PX = 12;   // up to this radius, CSS pixels, the arrow's picture is kept for each heading
const HEADINGS = 64;

export class CanvasRenderer {
  name = "canvas";
  #picture = null;
  #still = new OffscreenCanvas(1, 1);
  #drawn = "";
  #bodies = new Map();  // paint and look of a robot -> its picture
  #arrows = [];         // heading, and HEADINGS for a loaded robot -> the picture of arrow and load
  #radius = 0;
  #slots = [];          // what was drawn for each robot: {paint, look, body}

  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    this.context = canvas.getContext("2d");
    this.cellsVersion = -1;
  }

  readColours(colour) {
    this.colour = colour;
    this.cellsVersion = -1;
    this.#drawn = "";
    this.#forget();
  }

  #forget() {
    this.#bodies.clear();
    this.#arrows.length = this.#slots.length = 0;
  }

  // Only the robots: floor and lines are on another canvas.
  drawRobots(camera) {
    const { map } = this.scene.fleet;
    if (!map) return;
    this.context.clearRect(0, 0, camera.width, camera.height);
    this.#drawRobots(map, camera);
  }

  // Floor and lines are kept in a picture, which is made again when they or the camera change.
  draw(camera, { grid, over }) {
    const { scene } = this;
    const { map } = scene.fleet;
    const { width, height } = camera;
    if (!map) return;
    const wanted = [width, height, camera.left, camera.bottom, camera.scale, grid, over, scene.cellsVersion, scene.linesVersion, this.colour.cell].join();
    if (this.#drawn !== wanted) {
      this.#drawn = wanted;
      if (this.#still.width !== width || this.#still.height !== height) this.#still = new OffscreenCanvas(width, height);
      this.context = this.#still.getContext("2d");
      this.context.clearRect(0, 0, width, height);
      if (grid) this.#drawFloor(map, camera, over);
      this.#drawLines(camera);
    }
    this.context = this.canvas.getContext("2d");
    this.context.clearRect(0, 0, width, height);
    this.context.drawImage(this.#still, 0, 0);
    this.#drawRobots(map, camera);
  }

  // One pixel for each cell, then lines and boxes if cells are large enough.
  #makePicture(map, over) {
    const { cells } = this.scene;
    this.#picture = new OffscreenCanvas(map.columns, map.rows);
    const context = this.#picture.getContext("2d");
    const picture = context.createImageData(map.columns, map.rows);
    const palette = [this.colour.cell, this.colour.wall, this.colour.shut, this.colour.pending].map(rgb);
    const [heat, zone] = [rgb(this.colour.heat), rgb(this.colour.zone)];
    for (let cell = 0; cell < map.rows * map.columns; cell++) {
      const [kind, hot, zoned] = cells.subarray(4 * cell, 4 * cell + 3);
      let colour = palette[kind];
      if (zoned) colour = colour.map((part, index) => 0.75 * part + 0.25 * zone[index]);
      const share = hot ? 0.2 + 0.7 * Math.sqrt(hot / 255) : 0;
      colour = colour.map((part, index) => (1 - share) * part + share * heat[index]);
      picture.data.set([...colour, over ? (kind === CELL.free && !hot && !zoned ? 0 : 115) : 255], 4 * cell);
    }
    context.putImageData(picture, 0, 0);
  }

  #drawFloor(map, camera, over) {
    const { context, scene, colour } = this;
    if (this.cellsVersion !== scene.cellsVersion || this.over !== over) {
      this.cellsVersion = scene.cellsVersion;
      this.over = over;
      this.#makePicture(map, over);
    }
    const side = map.cell_size * camera.scale;
    context.save();
    context.translate(camera.x(map.origin[0]), camera.y(map.origin[1]));
    context.rotate(-(map.yaw ?? 0));
    context.scale(side, -side);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.#picture, 0, 0, map.columns, map.rows);
    if (side > 5) {
      context.strokeStyle = colour.line;
      context.lineWidth = 1 / side;
      context.beginPath();
      for (let row = 0; row <= map.rows; row++) {
        context.moveTo(0, row);
        context.lineTo(map.columns, row);
      }
      for (let column = 0; column <= map.columns; column++) {
        context.moveTo(column, 0);
        context.lineTo(column, map.rows);
      }
      context.stroke();
    }
    for (let cell = 0; cell < map.rows * map.columns; cell++) {
      if (scene.cells[4 * cell] === CELL.blocked) this.#drawBox((cell % map.columns) + 0.5, Math.floor(cell / map.columns) + 0.5, side);
    }
    context.restore();
  }

  #drawBox(x, y, side) {
    const { context, colour } = this;
    const half = BOX / 2;
    context.fillStyle = colour.box;
    context.strokeStyle = colour.boxedge;
    context.lineWidth = Math.max(0.04, 1 / side);
    context.fillRect(x - half, y - half, BOX, BOX);
    context.strokeRect(x - half, y - half, BOX, BOX);
    context.beginPath();
    context.moveTo(x - half, y - half);
    context.lineTo(x + half, y + half);
    context.moveTo(x - half, y + half);
    context.lineTo(x + half, y - half);
    context.stroke();
  }

  // Lines of one look that follow each other are one path.
  #drawLines(camera) {
    const { context } = this;
    const { lines, lineCount } = this.scene;
    let look = "";
    context.lineCap = "round";
    context.beginPath();
    for (let index = 0; index < lineCount; index++) {
      const at = 4 * LINE_TEXELS * index;
      const next = `${lines[at + 4]} ${lines[at + 5]} ${lines[at + 6]} ${lines[at + 7]}`;
      if (next !== look) {
        if (look) context.stroke();
        look = next;
        context.strokeStyle = cssOf(lines[at + 4], lines[at + 5]);
        context.lineWidth = lines[at + 6] * devicePixelRatio;
        context.setLineDash(lines[at + 7] ? [5 * devicePixelRatio, 4 * devicePixelRatio] : []);
        context.beginPath();
      }
      context.moveTo(camera.x(lines[at]), camera.y(lines[at + 1]));
      context.lineTo(camera.x(lines[at + 2]), camera.y(lines[at + 3]));
    }
    if (look) context.stroke();
    context.setLineDash([]);
  }

  // Runs for each robot and frame: it makes no objects while robots keep their looks and headings.
  #drawRobots(map, camera) {
    const { context, scene } = this;
    const radius = Math.max(LEAST_ROBOT_PX * devicePixelRatio, (map.robot_radius ?? 0.25) * camera.scale);
    if (radius !== this.#radius) this.#forget();
    this.#radius = radius;
    const half = Math.ceil(SPRITE * radius);
    const small = radius <= SMALL_PX * devicePixelRatio;
    const { robots, robotCount } = scene;
    while (this.#slots.length < robotCount) this.#slots.push({ paint: -1, look: -1, body: null });
    for (let index = 0; index < robotCount; index++) {
      const at = 4 * ROBOT_TEXELS * index;
      const x = camera.left + robots[at] * camera.scale;
      const y = camera.bottom - robots[at + 1] * camera.scale;
      if (x < -half || y < -half || x > camera.width + half || y > camera.height + half) continue;
      const yaw = robots[at + 2];
      const look = robots[at + 3];
      const paint = robots[at + 4];
      const slot = this.#slots[index];
      if (slot.look !== look || slot.paint !== paint) {
        slot.look = look;
        slot.paint = paint;
        slot.body = this.#body(paint, look);
      }
      // A picture that is neither turned nor between pixels is copied, which is several times as fast.
      if (small) {
        const [left, top] = [Math.round(x) - half, Math.round(y) - half];
        context.drawImage(slot.body, left, top);
        context.drawImage(this.#arrow(Math.round((yaw * HEADINGS) / (2 * Math.PI)) & (HEADINGS - 1), look), left, top);
      } else {
        const cos = Math.cos(yaw);
        const sin = Math.sin(yaw);
        context.setTransform(cos, -sin, sin, cos, x, y);
        context.drawImage(slot.body, -half, -half);
        context.drawImage(this.#arrow(0, look), -half, -half);
      }
    }
    if (!small) context.setTransform(1, 0, 0, 1, 0, 0);
  }

  // A canvas for a picture of a robot, whose middle is at 0, 0.
  #sheet() {
    const half = Math.ceil(SPRITE * this.#radius);
    const made = new OffscreenCanvas(2 * half, 2 * half);
    made.getContext("2d").translate(half, half);
    return made;
  }

  // The arrow of a robot, and its load.
  #arrow(heading, look) {
    const place = heading + (look & LOOK.loaded ? HEADINGS : 0);
    if (this.#arrows[place]) return this.#arrows[place];
    const made = this.#sheet();
    const context = made.getContext("2d");
    const radius = this.#radius;
    context.rotate((-2 * Math.PI * heading) / HEADINGS);
    context.fillStyle = "#fff";
    context.beginPath();
    context.moveTo(radius * 0.85, 0);
    context.lineTo(-radius * 0.2, radius * 0.5);
    context.lineTo(-radius * 0.2, -radius * 0.5);
    context.fill();
    if (look & LOOK.loaded) {
      context.fillStyle = this.colour.box;
      context.strokeStyle = this.colour.boxedge;
      context.lineWidth = Math.max(1, radius * 0.1);
      context.fillRect(-0.85 * radius, -0.5 * radius, radius, radius);
      context.strokeRect(-0.85 * radius, -0.5 * radius, radius, radius);
    }
    return (this.#arrows[place] = made.transferToImageBitmap());
  }

  // The disc of a robot and its mark; paint: its colour, look: as in the scene.
  #body(paint, look) {
    const key = paint * 64 + look;
    const known = this.#bodies.get(key);
    if (known) return known;
    const made = this.#sheet();
    const context = made.getContext("2d");
    const { colour } = this;
    const radius = this.#radius;
    const mark = (look / LOOK.mark) & 7;
    context.fillStyle = cssOf(paint);
    context.beginPath();
    context.arc(0, 0, radius, 0, 2 * Math.PI);
    context.fill();
    if (mark !== MARK.none) {
      context.strokeStyle = mark === MARK.manual ? colour.warn : colour.bad;
      context.lineWidth = radius * 0.35;
      context.setLineDash(mark === MARK.offline ? [radius, radius * 0.6] : []);
      context.beginPath();
      if (mark === MARK.stopped) context.rect(-1.5 * radius, -1.5 * radius, 3 * radius, 3 * radius);
      else if (mark === MARK.lost) [[1.55, 0], [0, 1.55], [-1.55, 0], [0, -1.55], [1.55, 0]].forEach(([x, y]) => context.lineTo(x * radius, y * radius));
      else if (mark === MARK.manual) for (const side of [-1.35, 1.35]) {
        context.moveTo(-1.1 * radius, side * radius);
        context.lineTo(1.1 * radius, side * radius);
      }
      else context.arc(0, 0, 1.35 * radius, 0, 2 * Math.PI);
      context.stroke();
    }
    if (look & LOOK.selected) {
      context.strokeStyle = colour.ink;
      context.setLineDash([]);
      context.lineWidth = Math.max(2, radius * 0.2);
      context.beginPath();
      context.arc(0, 0, 1.1 * radius, 0, 2 * Math.PI);
      context.stroke();
    }
    const picture = made.transferToImageBitmap();
    this.#bodies.set(key, picture);
    return picture;
  }
}

// A colour of the scene, one number, as a style.
function cssOf(paint, alpha = 1) {
  return `rgb(${paint & 255} ${(paint >> 8) & 255} ${(paint >> 16) & 255} / ${alpha})`;
}
