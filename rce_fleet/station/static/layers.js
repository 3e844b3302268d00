// The layers of one robot: which are shown, and their newest messages. Independent of the screen.
// A frame has the length of its header (uint32), the header (JSON), and numbers; all little-endian.

import { t } from "./texts.js";

export const LAYERS = ["map", "global_costmap", "local_costmap", "plan", "scan", "particles"];

export const UNKNOWN = 255;
const GRIDS = new Set(["map", "global_costmap", "local_costmap"]);

export class Layers extends EventTarget {
  robot = null;         // id of the robot whose layers are shown
  shown = new Set();    // names of layers
  grid = true;          // whether the fleet's grid is drawn
  newest = new Map();   // name -> {header, received, ...}: cells of grids, points of scans, values of others
  troubles = new Map(); // name -> why its newest message is not shown
  #send;

  constructor(send) {
    super();
    this.#send = send;
  }

  look(robot) {
    if (robot === this.robot) return;
    this.robot = robot;
    this.newest.clear();
    this.troubles.clear();
    this.request();
  }

  toggle(name, on) {
    if (on) this.shown.add(name);
    else this.shown.delete(name);
    this.newest.delete(name);
    this.troubles.delete(name);
    this.request();
  }

  toggleGrid(on) {
    this.grid = on;
    this.#changed();
  }

  // Ask the station for the layers; it stops those of before.
  request() {
    this.#send({ robot: this.robot ?? "", layers: this.robot === null ? [] : [...this.shown] });
    this.#changed();
  }

  // A text of the station: why a layer's newest message is not shown; empty if it is.
  take({ robot, layer, text }) {
    if (!this.#wants(robot, layer)) return;
    if (text) this.troubles.set(layer, text);
    else this.troubles.delete(layer);
    this.#changed();
  }

  async takeFrame(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const { robot, layer } = header;
    if (!this.#wants(robot, layer)) return;
    const entry = { header, received: performance.now() };
    this.newest.set(layer, { ...this.newest.get(layer), coming: entry });
    if (GRIDS.has(layer)) entry.cells = await inflate(buffer, 4 + length);
    else if (layer === "scan") entry.points = scanPoints(header, new Float32Array(buffer, 4 + length));
    else entry.values = new Float32Array(buffer, 4 + length);
    // While a grid was unpacked, a newer one may have come, or the layer was turned off.
    if (this.newest.get(layer)?.coming !== entry) return;
    this.newest.set(layer, entry);
    this.#changed();
  }

  // What the operator should know about a layer: trouble, notes, age.
  note(name) {
    if (!this.shown.has(name)) return "";
    if (this.robot === null) return t("layers.pick");
    const trouble = this.troubles.get(name);
    if (trouble) return trouble;
    const entry = this.newest.get(name);
    if (!entry?.header) return t("layers.waiting");
    const age = Math.round((performance.now() - entry.received) / 1000);
    return [...entry.header.notes, ...(age >= 5 ? [t("layers.age", { seconds: age })] : [])].join("; ");
  }

  #wants(robot, layer) {
    return robot === this.robot && this.shown.has(layer);
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}

async function inflate(buffer, offset) {
  const packed = new Blob([new Uint8Array(buffer, offset)]).stream();
  return new Uint8Array(await new Response(packed.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
}

// The ends of the rays in the scanner's frame: x, y one after the other. Rays without a return are left out.
function scanPoints({ angle_min, angle_increment, range_min, range_max }, ranges) {
  const points = new Float32Array(2 * ranges.length);
  let count = 0;
  ranges.forEach((range, index) => {
    if (!(range >= range_min && range < range_max)) return;
    const angle = angle_min + index * angle_increment;
    points[count++] = range * Math.cos(angle);
    points[count++] = range * Math.sin(angle);
  });
  return points.subarray(0, count);
}
