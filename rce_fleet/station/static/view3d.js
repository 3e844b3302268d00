// The world in three dimensions: floor, walls, boxes, people, robots; the simulation's truth beside what robots believe.

import { rgb } from "./colours.js";
import { Items, UNPACK, itemParts, makeContext, packed, program, roomFor } from "./gl.js";
import { paintOf } from "./scene.js";

const TEXELS = 3; // x, y, z, yaw; length, width, height, colour; alpha, three that are not used
const AWAKE_MS = 600; // frames are drawn for so long after something changed
const WALL_M = 0.6;
const BOX_M = 0.45;
const PERSON_M = 1.7;
const FIELD = Math.PI / 4;
const SIDES = 20; // of a cylinder
const MARGIN = 1.04;
const LEAST_ROBOT = 0.006; // diameter of a robot as it is drawn, of the distance

const VERTEX = `
${itemParts(TEXELS)}
${UNPACK}
uniform mat4 camera;
uniform int shape;    // 0 box, 1 cylinder, 2 arrow
out vec4 tint;
const int corners[36] = int[36](0,1,3, 0,3,2, 4,7,5, 4,6,7, 0,5,1, 0,4,5, 2,3,7, 2,7,6, 0,2,6, 0,6,4, 1,5,7, 1,7,3);
const vec3 faces[6] = vec3[6](vec3(0,0,-1), vec3(0,0,1), vec3(0,-1,0), vec3(0,1,0), vec3(-1,0,0), vec3(1,0,0));
void main() {
  int vertices = shape == 0 ? 36 : shape == 1 ? ${9 * SIDES} : 3;
  int item = gl_VertexID / vertices, vertex = gl_VertexID % vertices;
  vec4 at = part(item, 0), more = part(item, 1);
  vec3 size = more.xyz;
  vec4 shade = vec4(unpack(more.w), part(item, 2).x);
  vec3 p;
  vec3 normal;
  if (shape == 0) {
    int corner = corners[vertex];
    p = vec3(float(corner & 1) - 0.5, float((corner >> 1) & 1) - 0.5, float(corner >> 2));
    normal = faces[vertex / 6];
  } else if (shape == 1) {
    int side = vertex / 9, place = vertex % 9;
    float a = 6.2831853 * float(side) / ${SIDES}.0, b = 6.2831853 * float(side + 1) / ${SIDES}.0;
    bool second = place == 1 || place == 2 || place == 4 || place == 8;
    bool top = place == 2 || place == 4 || place == 5 || place > 5;
    float angle = second ? b : a;
    vec2 edge = vec2(cos(angle), sin(angle)) * 0.5;
    p = vec3(place == 6 ? vec2(0.0) : edge, top ? 1.0 : 0.0);
    normal = place > 5 ? vec3(0, 0, 1) : vec3(edge * 2.0, 0.0);
  } else {
    vec2 tips[3] = vec2[3](vec2(0.42, 0.0), vec2(-0.1, 0.25), vec2(-0.1, -0.25));
    p = vec3(tips[vertex], 1.02);
    normal = vec3(0, 0, 1);
  }
  p *= size;
  float c = cos(at.w), s = sin(at.w);
  vec3 world = at.xyz + vec3(p.x * c - p.y * s, p.x * s + p.y * c, p.z);
  vec3 turned = vec3(normal.x * c - normal.y * s, normal.x * s + normal.y * c, normal.z);
  float light = 0.55 + 0.45 * max(0.0, dot(turned, normalize(vec3(0.4, -0.5, 0.8))));
  tint = vec4(shade.rgb * (shape == 2 ? 1.0 : light), shade.a);
  gl_Position = camera * vec4(world, 1.0);
}`;

const FRAGMENT = `
in vec4 tint;
out vec4 colour;
void main() { colour = vec4(tint.rgb * tint.a, tint.a); }`;

const VERTICES = [36, 9 * SIDES, 3];

export class World3d {
  models = [];          // of the simulation: [name, x, y, yaw]
  dragged = null;       // one of these where the pointer has it
  orbit = { x: 0, y: 0, distance: 10, turn: -Math.PI / 2, tilt: 0.9 };
  follows = true;       // show everything until the operator turns, zooms or pans
  #shown = false;
  #waiting = null;
  #until = 0;
  #still = "";          // what the floor and the walls were made from
  #sets = [];           // of items: {shape, vertices, items, numbers, count}; the first has floor, walls and boxes

  constructor(canvas, scene, fleet) {
    this.canvas = canvas;
    this.scene = scene;
    this.fleet = fleet;
    const gl = makeContext(canvas);
    this.gl = gl;
    if (!gl) return;
    this.program = program(gl, VERTEX, FRAGMENT);
    this.#sets = [0, 0, 1, 2].map((shape) => ({ shape, vertices: VERTICES[shape], items: new Items(gl, TEXELS), numbers: new Float32Array(0), count: 0 }));
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    fleet.addEventListener("map", () => this.fit());
    fleet.addEventListener("world", () => { this.models = fleet.models; });
    for (const type of ["map", "things", "state", "changes", "selected"]) fleet.addEventListener(type, () => this.wake());
    for (const type of ["poses", "world"]) fleet.addEventListener(type, () => { if (fleet.hasMoved) this.wake(); });
    for (const type of ["pointerdown", "pointermove", "pointerup", "wheel", "keydown"]) canvas.addEventListener(type, () => this.wake());
    new ResizeObserver(() => { if (this.follows) this.fit(); this.wake(); }).observe(canvas);
  }

  get shown() { return this.#shown; }

  set shown(shown) {
    this.#shown = shown;
    this.wake();
  }

  // Draw for a moment: something changed. Nothing is drawn while the view is not shown.
  wake() {
    this.#until = performance.now() + AWAKE_MS;
    if (!this.#shown || this.#waiting !== null) return;
    const frame = () => {
      this.#waiting = null;
      if (!this.#shown) return;
      this.draw();
      if (performance.now() < this.#until) this.#waiting = requestAnimationFrame(frame);
    };
    this.#waiting = requestAnimationFrame(frame);
  }

  readColours(colour) {
    this.colour = colour;
    this.#still = "";
    this.wake();
  }

  // Show the whole floor: its nearer edge is as wide as the view, or its depth as high.
  fit() {
    if (!this.fleet.map) return;
    this.follows = true;
    const [x0, y0, x1, y1] = this.fleet.bounds();
    const { orbit, canvas } = this;
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight) || 1;
    const reach = Math.tan(FIELD / 2);
    const [across, deep] = [(x1 - x0) / 2, (y1 - y0) / 2];
    const away = Math.max(across / (reach * aspect), (deep * Math.sin(orbit.tilt)) / reach);
    Object.assign(orbit, { x: (x0 + x1) / 2, y: (y0 + y1) / 2, turn: -Math.PI / 2, distance: MARGIN * (away + deep * Math.cos(orbit.tilt)) });
  }

  // The matrix of the camera, column by column.
  #camera() {
    const { x, y, distance, turn, tilt } = this.orbit;
    const out = [Math.cos(tilt) * Math.cos(turn), Math.cos(tilt) * Math.sin(turn), Math.sin(tilt)];
    const right = [-Math.sin(turn), Math.cos(turn), 0];
    const up = [out[1] * right[2] - out[2] * right[1], out[2] * right[0] - out[0] * right[2], out[0] * right[1] - out[1] * right[0]];
    const eye = [x + distance * out[0], y + distance * out[1], distance * out[2]];
    this.view = { eye, right, up, out };
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const rows = [right, up, out].map((axis) => [...axis, -dot(axis, eye)]);
    const f = 1 / Math.tan(FIELD / 2);
    const aspect = this.canvas.width / this.canvas.height;
    const [near, far] = [distance / 50, distance * 20];
    const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    const matrix = new Float32Array(16);
    for (let column = 0; column < 4; column++) {
      matrix[4 * column] = (f / aspect) * rows[0][column];
      matrix[4 * column + 1] = f * rows[1][column];
      matrix[4 * column + 2] = a * rows[2][column] + (column === 3 ? b : 0);
      matrix[4 * column + 3] = -rows[2][column];
    }
    return matrix;
  }

  // The point of the floor under a pixel of the page; null above the horizon.
  floorAt(event) {
    this.#camera();
    const box = this.canvas.getBoundingClientRect();
    const reach = Math.tan(FIELD / 2);
    const across = ((2 * (event.clientX - box.left)) / box.width - 1) * reach * (box.width / box.height);
    const above = (1 - (2 * (event.clientY - box.top)) / box.height) * reach;
    const { eye, right, up, out } = this.view;
    const ray = [0, 1, 2].map((axis) => right[axis] * across + up[axis] * above - out[axis]);
    if (ray[2] > -1e-6) return null;
    const far = -eye[2] / ray[2];
    return [eye[0] + far * ray[0], eye[1] + far * ray[1]];
  }

  // set: a place in #sets; paint: a colour as one number.
  #add(set, x, y, z, yaw, length, width, height, paint, alpha = 1) {
    const at = 4 * TEXELS * set.count++;
    if (at + 4 * TEXELS > set.numbers.length) set.numbers = roomFor(set.numbers, set.count, TEXELS);
    const { numbers } = set;
    numbers[at] = x;
    numbers[at + 1] = y;
    numbers[at + 2] = z;
    numbers[at + 3] = yaw;
    numbers[at + 4] = length;
    numbers[at + 5] = width;
    numbers[at + 6] = height;
    numbers[at + 7] = paint;
    numbers[at + 8] = alpha;
  }

  // Floor, walls and boxes in cells are made again when they change.
  #collectStill() {
    const { fleet, scene, colour } = this;
    const { map } = fleet;
    const wanted = `${scene.cellsVersion} ${this.models.length > 0}`;
    if (wanted === this.#still) return;
    this.#still = wanted;
    const [still] = this.#sets;
    still.count = 0;
    const side = map.cell_size;
    const yaw = map.yaw ?? 0;
    const { frame } = fleet;
    const [x0, y0, x1, y1] = fleet.bounds();
    this.#add(still, (x0 + x1) / 2, (y0 + y1) / 2, -0.05, yaw, map.columns * side, map.rows * side, 0.05, packed(rgb(colour.cell)));
    const wall = packed(rgb(colour.wall));
    for (const cell of fleet.walls) this.#add(still, frame.x(cell), frame.y(cell), 0, yaw, side, side, WALL_M, wall);
    const box = packed(rgb(colour.box));
    for (const cell of scene.replay?.blocked ?? fleet.blocked) {
      if (!fleet.walls.has(cell)) this.#add(still, frame.x(cell), frame.y(cell), 0, yaw, 0.6 * side, 0.6 * side, 0.4, box, this.models.length ? 0.43 : 1);
    }
    still.items.fill(still.numbers, still.count);
  }

  #collectMoving() {
    const { fleet, scene, colour } = this;
    const [, boxes, cylinders, arrows] = this.#sets;
    for (const set of [boxes, cylinders, arrows]) set.count = 0;
    const [box, truth, ink, person] = ["box", "truth", "ink", "person"].map((name) => packed(rgb(colour[name])));
    const radius = Math.max(fleet.map.robot_radius ?? 0.25, 0.5 * LEAST_ROBOT * this.orbit.distance);
    for (const robot of scene.shownRobots.values()) {
      if (!robot.shown) continue;
      const { x, y, theta } = robot.shown;
      const height = (robot.id === fleet.selected ? 2.5 : 1.6) * radius;
      this.#add(cylinders, x, y, 0, theta, 2 * radius, 2 * radius, height, paintOf(robot));
      this.#add(arrows, x, y, 0, theta, 2 * radius, 2 * radius, height + 0.01, 0xffffff);
      if (robot.loads) this.#add(boxes, x - 0.35 * radius * Math.cos(theta), y - 0.35 * radius * Math.sin(theta), height, theta, radius, radius, radius, box);
    }
    for (const model of scene.replay ? [] : this.models) {
      const [name, x, y, theta] = model[0] === this.dragged?.[0] ? this.dragged : model;
      const [kind, width, depth] = this.fleet.things[name] ?? [];
      if (kind === "robot" || kind === "light") {
        this.#add(cylinders, x, y, 0, theta, 2.5 * radius, 2.5 * radius, 0.36 * radius, truth);
        this.#add(arrows, x, y, 0, theta, 2.5 * radius, 2.5 * radius, 0.4 * radius, ink);
      } else if (kind === "box") this.#add(boxes, x, y, 0, theta, width, depth, BOX_M, box);
      else if (kind === "walker") {
        this.#add(cylinders, x, y, 0, theta, 2 * width, 2 * width, PERSON_M - 0.3, person);
        this.#add(cylinders, x, y, PERSON_M - 0.25, theta, 0.25, 0.25, 0.25, person);
      }
    }
    for (const { items, numbers, count } of [boxes, cylinders, arrows]) items.fill(numbers, count);
  }

  draw() {
    const { gl, canvas } = this;
    if (!gl || !this.fleet.map || !this.colour) return;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * devicePixelRatio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    this.#collectStill();
    this.#collectMoving();
    const ground = rgb(this.colour.line).map((part) => part / 255);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.program.use();
    gl.uniformMatrix4fv(this.program.at.camera, false, this.#camera());
    for (const { shape, vertices, items } of this.#sets) {
      gl.uniform1i(this.program.at.shape, shape);
      items.draw(vertices);
    }
  }
}
