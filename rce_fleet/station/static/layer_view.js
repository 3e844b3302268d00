// Draws layers on the map's canvas. Layers differ in shape as well as in colour and lightness.

import { UNKNOWN } from "./layers.js";

const MAP_OPACITY = 0.9;
const COSTMAP_OPACITY = 0.65;
const INSCRIBED = 99;   // costs of ROS's costmaps: the robot's centre would touch an obstacle
const LETHAL = 100;
const POINT_PX = 3;
const ARROW_PX = 9;
const OCCUPIED = 65;
const FREE = 25;

export class LayerView {
  #images = new Map(); // entry of a grid -> its picture

  constructor(layers) {
    this.layers = layers;
  }

  // Colours changed: pictures are made again.
  readColours(style) {
    const colour = (name) => style.getPropertyValue(`--layer-${name}`).trim();
    this.colour = Object.fromEntries(["scan", "particles", "plan", "occupied", "free", "unknown", "cost", "lethal"].map((name) => [name, colour(name)]));
    this.#images.clear();
  }

  // place: {context, left, bottom, scale}: pixels of the canvas, and pixels per metre.
  drawBelow(place) {
    this.#drawGrid(place, "map", MAP_OPACITY);
    this.#drawGrid(place, "global_costmap", COSTMAP_OPACITY);
    this.#drawGrid(place, "local_costmap", COSTMAP_OPACITY);
  }

  drawAbove(place) {
    this.#drawPlan(place);
    this.#drawScan(place);
    this.#drawParticles(place);
  }

  get hasGround() {
    return ["map", "global_costmap", "local_costmap"].some((name) => this.layers.newest.get(name)?.cells !== undefined);
  }

  get hasMap() {
    return this.layers.newest.get("map")?.cells !== undefined;
  }

  // Go to a frame: its unit is the metre, y is up.
  #enter({ context, left, bottom, scale }, [x, y, yaw]) {
    context.save();
    context.translate(left + x * scale, bottom - y * scale);
    context.rotate(-yaw);
    context.scale(scale, -scale);
  }

  #drawGrid(place, name, opacity) {
    const entry = this.layers.newest.get(name);
    if (!entry?.cells) return;
    const { context } = place;
    const { pose, origin: [x, y, yaw], resolution, rows, columns } = entry.header;
    this.#enter(place, pose);
    context.translate(x, y);
    context.rotate(yaw);
    context.scale(resolution, resolution);
    context.globalAlpha = opacity;
    context.imageSmoothingEnabled = false;
    context.drawImage(this.#image(name, entry), 0, 0, columns, rows);
    context.restore();
  }

  #image(name, entry) {
    const known = this.#images.get(name);
    if (known?.entry === entry) return known.canvas;
    const { rows, columns } = entry.header;
    const canvas = new OffscreenCanvas(columns, rows);
    const context = canvas.getContext("2d");
    const picture = context.createImageData(columns, rows);
    const palette = name === "map" ? this.#mapPalette() : this.#costPalette();
    const pixels = new Uint32Array(picture.data.buffer);
    entry.cells.forEach((cell, index) => { pixels[index] = palette[cell]; });
    context.putImageData(picture, 0, 0);
    this.#images.set(name, { entry, canvas });
    return canvas;
  }

  #mapPalette() {
    const [occupied, free, unknown] = [this.colour.occupied, this.colour.free, this.colour.unknown].map(rgb);
    const palette = new Uint32Array(256).fill(pixel(unknown, 255));
    for (let value = 0; value <= 100; value++) {
      if (value <= FREE) palette[value] = pixel(free, 255);
      if (value >= OCCUPIED) palette[value] = pixel(occupied, 255);
    }
    return palette;
  }

  // Free and unknown cells are transparent, costs grow darker, obstacles have a colour of their own.
  #costPalette() {
    const [cost, lethal] = [this.colour.cost, this.colour.lethal].map(rgb);
    const palette = new Uint32Array(256);
    for (let value = 1; value < INSCRIBED; value++) palette[value] = pixel(cost, 30 + Math.round(1.4 * value));
    palette[INSCRIBED] = pixel(cost, 255);
    for (let value = LETHAL; value < UNKNOWN; value++) palette[value] = pixel(lethal, 255);
    return palette;
  }

  #drawScan(place) {
    const entry = this.layers.newest.get("scan");
    if (!entry?.points) return;
    const { context, scale } = place;
    const side = (POINT_PX * devicePixelRatio) / scale;
    this.#enter(place, entry.header.pose);
    context.fillStyle = this.colour.scan;
    const { points } = entry;
    for (let index = 0; index < points.length; index += 2) context.fillRect(points[index] - side / 2, points[index + 1] - side / 2, side, side);
    context.restore();
  }

  #drawParticles(place) {
    const entry = this.layers.newest.get("particles");
    if (!entry?.values) return;
    const { context, scale } = place;
    const length = (ARROW_PX * devicePixelRatio) / scale;
    this.#enter(place, entry.header.pose);
    context.strokeStyle = this.colour.particles;
    context.lineWidth = (1.2 * devicePixelRatio) / scale;
    context.beginPath();
    const { values } = entry;
    for (let index = 0; index < values.length; index += 3) {
      const [x, y, yaw] = values.subarray(index, index + 3);
      const [tipX, tipY] = [x + length * Math.cos(yaw), y + length * Math.sin(yaw)];
      context.moveTo(x, y);
      context.lineTo(tipX, tipY);
      for (const side of [2.6, -2.6]) {
        context.moveTo(tipX, tipY);
        context.lineTo(tipX + 0.4 * length * Math.cos(yaw + side), tipY + 0.4 * length * Math.sin(yaw + side));
      }
    }
    context.stroke();
    context.restore();
  }

  #drawPlan(place) {
    const entry = this.layers.newest.get("plan");
    if (!entry?.values) return;
    const { context, scale } = place;
    this.#enter(place, entry.header.pose);
    context.strokeStyle = this.colour.plan;
    context.lineWidth = (3 * devicePixelRatio) / scale;
    context.lineJoin = "round";
    context.beginPath();
    const { values } = entry;
    for (let index = 0; index < values.length; index += 3) context.lineTo(values[index], values[index + 1]);
    context.stroke();
    context.restore();
  }
}

// The parts of a colour such as #1b2330.
function rgb(text) {
  return [1, 3, 5].map((start) => parseInt(text.slice(start, start + 2), 16));
}

// A pixel of an ImageData, as a little-endian number.
function pixel([red, green, blue], alpha) {
  return ((alpha << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
