// The map: canvases over each other (layers below, the fleet, texts and tools), drawn when something changed.

import { Camera } from "./camera.js";
import { readColours } from "./colours.js";
import { CanvasRenderer } from "./fleet_canvas.js";
import { GlRenderer } from "./fleet_gl.js";
import { SplitRenderer } from "./fleet_split.js";
import { isSoftware } from "./gl.js";
import { LayerView } from "./layer_view.js";
import { Overlay } from "./overlay.js";
import { MANY, Scene } from "./scene.js";

const MARGIN = 0.15;         // of a cell, around the map
const LINES_EVERY_MS = 100;  // paths and trails are made again at most this often
const LINES_OF_MANY_MS = 500; // the same with more robots than 300
const CELLS_EVERY_MS = 1000; // congestion is counted again at most this often

export class View {
  changed = () => {}; // called when robots, or what is drawn with them, may look different
  cursor = null; // cell under the pointer or the keyboard
  meter = { frames: 0, drawn: 0, script_ms: 0, longest_ms: 0 };
  #editor = null;
  #last = 0;
  #madeAt = { lines: 0, cells: 0 };
  #waiting = null;      // for the next frame
  #timer = null;        // until what was made a moment ago may be made again
  #needs = { ground: true, fleet: true, overlay: true, lines: true, cells: true };

  // stage: the element with the canvases #ground, #still, #fleet and #map.
  constructor(stage, fleet, layers) {
    this.stage = stage;
    this.canvas = stage.querySelector("#map");
    this.ground = stage.querySelector("#ground");
    this.fleet = fleet;
    this.scene = new Scene(fleet);
    this.camera = new Camera();
    this.layers = new LayerView(layers);
    this.context = this.ground.getContext("2d");
    this.renderer = this.#makeRenderer(stage);
    this.overlay = new Overlay(this);
    new ResizeObserver(() => this.#resize()).observe(stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readColours());
    this.camera.addEventListener("change", () => this.touch());
    layers.addEventListener("change", () => this.touch("ground", "overlay", "fleet"));
    fleet.addEventListener("map", () => { this.#fit(); this.touch("cells", "lines", "overlay"); });
    for (const type of ["state", "changes", "selected"]) fleet.addEventListener(type, () => this.touch("lines", "overlay", "fleet"));
    for (const type of ["state", "cells"]) fleet.addEventListener(type, () => this.touch("cells"));
    fleet.addEventListener("changes", () => { if (this.scene.shown.congestion) this.touch("cells"); });
    fleet.addEventListener("control", () => this.touch("fleet", "overlay"));
    fleet.addEventListener("poses", () => {
      if (!fleet.hasMoved) return;
      if (fleet.robots.size <= MANY || this.scene.shown.trails === "all") this.touch("lines");
      this.#wake();
    });
    this.readColours();
    this.#resize();
  }

  // ?renderer=webgl, split or canvas chooses one, to try it.
  #makeRenderer(stage) {
    const [still, canvas] = ["#still", "#fleet"].map((name) => stage.querySelector(name));
    const wanted = new URLSearchParams(location.search).get("renderer");
    const isSplit = wanted === "split" || (!wanted && isSoftware());
    still.hidden = !isSplit;
    try {
      if (isSplit) return new SplitRenderer(still, canvas, this.scene);
      if (wanted !== "canvas") return new GlRenderer(canvas, this.scene);
    } catch (error) {
      console.info(`drawing without WebGL: ${error.message}`);
      still.hidden = true;
    }
    return new CanvasRenderer(canvas, this.scene);
  }

  get left() { return this.camera.left; }
  get bottom() { return this.camera.bottom; }
  get scale() { return this.camera.scale; }
  get ratio() { return this.canvas.width / Math.max(1, this.canvas.getBoundingClientRect().width); }
  get editor() { return this.#editor; }

  set editor(editor) {
    this.#editor = editor;
    editor.addEventListener("shown", () => { this.#fit(); this.touch(); });
  }

  // Note what must be drawn again: ground, fleet, overlay, lines, cells; without a name, all that the camera moves.
  touch(...names) {
    for (const name of names.length ? names : ["ground", "fleet", "overlay"]) this.#needs[name] = true;
    this.#wake();
  }

  // Frames are drawn while something moves or waits to be drawn; otherwise the page rests.
  #wake() {
    if (this.#waiting !== null) return;
    this.#waiting = requestAnimationFrame((now) => {
      this.#waiting = null;
      this.#frame(now);
    });
  }

  set cursorCell(cell) {
    if (cell === this.cursor) return;
    this.cursor = cell;
    this.touch("overlay");
  }

  worldAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const ratio = this.canvas.width / box.width;
    return this.camera.worldAt((event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio);
  }

  // Where the middle of a cell is on the page, in CSS pixels from the canvas' corner.
  screenOf(cell) {
    const [x, y] = this.fleet.centre(cell);
    return [this.camera.x(x) / this.ratio, this.camera.y(y) / this.ratio];
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    this.colour = readColours(style);
    this.renderer.readColours(this.colour);
    this.layers.readColours(style);
    this.touch();
  }

  #resize() {
    const ratio = window.devicePixelRatio || 1;
    const box = this.stage.getBoundingClientRect();
    const [width, height] = [box.width, box.height].map((side) => Math.max(1, Math.round(side * ratio)));
    for (const canvas of this.stage.querySelectorAll("canvas.flat")) {
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    }
    this.camera.resize(width, height);
    this.touch();
  }

  #fit() {
    const { map } = this.fleet;
    if (map) this.camera.show(this.fleet.bounds(this.editor?.proposed), MARGIN * map.cell_size);
  }

  #frame(now) {
    const started = performance.now();
    this.meter.frames++;
    this.draw(now);
    const spent = performance.now() - started;
    this.meter.script_ms += spent;
    this.meter.longest_ms = Math.max(this.meter.longest_ms, spent);
  }

  draw(now = performance.now()) {
    const seconds = Math.max(0.001, Math.min(0.1, (now - this.#last) / 1000));
    this.#last = now;
    const { fleet, scene } = this;
    if (!fleet.map) return;
    const needs = this.#needs;
    if (this.#isDue("cells", now, scene.shown.congestion ? CELLS_EVERY_MS : 0)) scene.makeCells();
    if (this.#isDue("lines", now, fleet.robots.size > 300 ? LINES_OF_MANY_MS : LINES_EVERY_MS)) scene.makeLines();
    const moving = scene.moveRobots(seconds);
    if (moving) this.#wake();
    if (moving || needs.fleet) this.changed();
    if (this.stage.hidden) return;
    if (needs.ground) {
      this.context.clearRect(0, 0, this.ground.width, this.ground.height);
      this.layers.drawBelow(this.#place(this.context));
      // An empty canvas costs as much as a full one where the page is put together without a graphics card.
      this.ground.style.visibility = this.layers.hasGround ? "" : "hidden";
      needs.ground = false;
    }
    if (moving || needs.fleet) {
      this.renderer.draw(this.camera, { grid: this.layers.layers.grid, over: this.layers.hasMap });
      this.meter.drawn++;
      needs.fleet = false;
    }
    if (needs.overlay || (moving && this.overlay.hasNames)) {
      this.overlay.draw();
      needs.overlay = false;
    }
  }

  // Whether something is needed and was not made a moment ago; if it was, another frame comes in time.
  #isDue(name, now, every) {
    if (!this.#needs[name]) return false;
    const rest = this.#madeAt[name] + every - now;
    if (rest > 0) {
      this.#timer ??= setTimeout(() => {
        this.#timer = null;
        this.#wake();
      }, rest);
      return false;
    }
    this.#madeAt[name] = now;
    this.#needs[name] = false;
    this.#needs.fleet = true;
    return true;
  }

  #place(context) {
    return { context, left: this.left, bottom: this.bottom, scale: this.scale };
  }

  drawLayersAbove(context) {
    this.layers.drawAbove(this.#place(context));
  }
}
