// Draws a scene with WebGL 2: the floor is one rectangle with a texture of cells, lines and robots are items.

import { rgb } from "./colours.js";
import { Items, UNPACK, itemParts, makeContext, program } from "./gl.js";
import { LINE_TEXELS, ROBOT_TEXELS } from "./scene.js";

const LEAST_ROBOT_PX = 3.2; // radius of a robot, CSS pixels, however far away

// From metres of the map to the clip space: (metres * scale + offset).
const PLACE = "uniform vec4 place; vec2 clip(vec2 p) { return p * place.xy + place.zw; }";
const QUAD = "const int quad[6] = int[6](0, 1, 2, 2, 1, 3);";

const FLOOR_VERTEX = `${PLACE}
uniform vec4 frame;  // origin x, y, cos yaw, sin yaw
uniform vec3 grid;   // columns, rows, cell size
out vec2 cell;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  cell = corner * grid.xy;
  vec2 metres = cell * grid.z;
  vec2 turned = vec2(metres.x * frame.z - metres.y * frame.w, metres.x * frame.w + metres.y * frame.z);
  gl_Position = vec4(clip(frame.xy + turned), 0.0, 1.0);
}`;

const FLOOR_FRAGMENT = `
uniform sampler2D cells;
uniform vec3 grid;
uniform float side;    // pixels of a cell
uniform float over;    // 1 over a map, whose free cells stay visible
uniform vec3 colours[9]; // cell, wall, shut, pending, box, box's edge, line, heat, zone
in vec2 cell;
out vec4 colour;
void main() {
  ivec2 index = clamp(ivec2(floor(cell)), ivec2(0), ivec2(grid.xy) - 1);
  vec4 state = texelFetch(cells, index, 0) * 255.0;
  int kind = int(state.r + 0.5);
  vec2 in_cell = fract(cell);
  vec3 base = kind == 1 ? colours[1] : kind == 2 ? colours[2] : kind == 3 ? colours[3] : colours[0];
  float alpha = over > 0.5 ? (kind == 0 ? 0.0 : 0.45) : 1.0;
  if (state.b > 0.5) {
    float stripe = step(0.5, fract((cell.x + (int(state.b + 0.5) % 2 == 0 ? cell.y : -cell.y)) * 2.0));
    base = mix(base, colours[8], 0.16 + 0.16 * stripe);
    alpha = max(alpha, 0.3);
  }
  float heat = state.g / 255.0;
  if (heat > 0.0) {
    base = mix(base, colours[7], 0.2 + 0.7 * sqrt(heat));
    alpha = max(alpha, 0.6);
  }
  if (kind == 2) {
    vec2 middle = abs(in_cell - 0.5);
    float reach = max(middle.x, middle.y);
    if (reach < 0.3) {
      float stroke = max(0.03, 0.8 / side);
      bool edge = reach > 0.3 - stroke || abs(middle.x - middle.y) < stroke;
      base = edge ? colours[5] : colours[4];
      alpha = 1.0;
    }
  }
  vec2 from_edge = min(in_cell, 1.0 - in_cell) * side;
  if (kind != 1 && side > 5.0 && min(from_edge.x, from_edge.y) < (side < 24.0 ? 0.5 : max(1.0, side * 0.012))) {
    base = colours[6];
    alpha = max(alpha, 0.5);
  }
  colour = vec4(base * alpha, alpha);
}`;

const LINE_VERTEX = `${PLACE}
${itemParts(LINE_TEXELS)}
${UNPACK}
${QUAD}
uniform vec2 screen;
uniform float ratio;
out vec4 tint;
out float along;
out float dash;
void main() {
  int item = gl_VertexID / 6, corner = quad[gl_VertexID % 6];
  vec4 ends = part(item, 0), look = part(item, 1);   // look: colour, alpha, width in pixels, dashes
  vec2 a = clip(ends.xy) * screen;   // half pixels from the middle
  vec2 b = clip(ends.zw) * screen;
  vec2 way = b - a;
  float length_px = length(way);
  vec2 direction = length_px > 0.001 ? way / length_px : vec2(1.0, 0.0);
  float half_width = look.z * ratio * 0.5;
  float at_end = float(corner & 1);
  float side = float(corner >> 1) * 2.0 - 1.0;
  vec2 at = mix(a - direction * half_width, b + direction * half_width, at_end) + vec2(-direction.y, direction.x) * side * half_width;
  along = at_end * length_px / ratio;
  dash = look.w;
  tint = vec4(unpack(look.x), look.y);
  gl_Position = vec4(at / screen, 0.0, 1.0);
}`;

const LINE_FRAGMENT = `
in vec4 tint;
in float along;
in float dash;
out vec4 colour;
void main() {
  if (dash > 0.5 && fract(along / 9.0) > 0.55) discard;
  colour = vec4(tint.rgb * tint.a, tint.a);
}`;

const ROBOT_VERTEX = `${PLACE}
${itemParts(ROBOT_TEXELS)}
${UNPACK}
${QUAD}
uniform vec2 screen;
uniform float radius;   // pixels
out vec2 at;
flat out vec3 tint;
flat out int marks;
void main() {
  int item = gl_VertexID / 6, number = quad[gl_VertexID % 6];
  vec4 pose = part(item, 0);
  vec2 corner = (vec2(number & 1, number >> 1) * 2.0 - 1.0) * 1.75;
  float c = cos(pose.z), s = sin(pose.z);
  at = corner;
  tint = unpack(part(item, 1).x);
  marks = int(pose.w + 0.5);
  vec2 turned = vec2(corner.x * c - corner.y * s, corner.x * s + corner.y * c);
  gl_Position = vec4(clip(pose.xy) + turned * radius / screen, 0.0, 1.0);
}`;

const ROBOT_FRAGMENT = `
in vec2 at;
flat in vec3 tint;
flat in int marks;
uniform float radius;
uniform vec3 ink;
uniform vec3 bad;
uniform vec3 warn;
uniform vec3 box;
uniform vec3 edge;
out vec4 colour;
void main() {
  float d = length(at);
  float soft = 1.0 / radius;
  int mark = (marks >> 1) & 7;
  vec4 drawn = vec4(tint, 1.0) * (1.0 - smoothstep(1.0 - soft, 1.0, d));
  bool arrow = at.x > -0.2 && at.x < 0.85 && abs(at.y) < 0.5 * (0.85 - at.x) / 1.05;
  if (d < 1.0 && arrow) drawn = vec4(1.0);
  if (mark == 2 && d < 1.0 && !arrow) drawn = mix(drawn, vec4(0.93, 0.93, 0.93, 1.0), step(0.45, fract((at.x + at.y) * 2.2)));
  float angle = atan(at.y, at.x);
  if (mark == 1 && d > 1.15 && d < 1.55) drawn = vec4(bad, 1.0);
  if (mark == 2 && d > 1.15 && d < 1.5 && fract(angle * 0.9549 + 0.25) < 0.5) drawn = vec4(bad, 1.0);
  if (mark == 3 && abs(at.y) > 1.2 && abs(at.y) < 1.5 && abs(at.x) < 1.1) drawn = vec4(warn, 1.0);
  float square = max(abs(at.x), abs(at.y));
  if (mark == 4 && square > 1.3 && square < 1.7) drawn = vec4(bad, 1.0);
  float diamond = abs(at.x) + abs(at.y);
  if (mark == 5 && diamond > 1.4 && diamond < 1.72) drawn = vec4(bad, 1.0);
  float load = max(abs(at.x + 0.35), abs(at.y));
  if (marks >= 16 && load < 0.5) drawn = vec4(load > 0.5 - max(0.1, soft) ? edge : box, 1.0);
  if ((marks & 1) == 1 && d > 1.0 && d < 1.22) drawn = vec4(ink, 1.0);
  if (drawn.a < 0.01) discard;
  colour = drawn;
}`;

// The factors and the offset from metres to the clip space.
function placeOf({ width, height, scale, left, bottom }) {
  return [(2 * scale) / width, (2 * scale) / height, (2 * left) / width - 1, 1 - (2 * bottom) / height];
}

export class GlRenderer {
  name = "WebGL";

  // Throws an error if the browser has no WebGL 2.
  constructor(canvas, scene) {
    const gl = makeContext(canvas);
    if (!gl) throw new Error("no WebGL 2");
    this.canvas = canvas;
    this.scene = scene;
    this.gl = gl;
    this.lost = false;
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); this.lost = true; });
    canvas.addEventListener("webglcontextrestored", () => { this.#make(); this.lost = false; });
    this.#make();
  }

  #make() {
    const { gl } = this;
    this.floor = program(gl, FLOOR_VERTEX, FLOOR_FRAGMENT);
    this.line = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.robot = program(gl, ROBOT_VERTEX, ROBOT_FRAGMENT);
    this.nothing = gl.createVertexArray();
    this.lines = new Items(gl, LINE_TEXELS);
    this.robots = new Items(gl, ROBOT_TEXELS);
    this.texture = gl.createTexture();
    [this.ground, this.still] = [1, 2].map(() => ({ picture: gl.createTexture(), frame: gl.createFramebuffer(), drawn: "" }));
    this.cellsVersion = this.linesVersion = -1;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  readColours(colour) {
    const floats = (name) => rgb(colour[name]).map((part) => part / 255);
    this.floorColours = new Float32Array(["cell", "wall", "shut", "pending", "box", "boxedge", "line", "heat", "zone"].flatMap(floats));
    this.colours = Object.fromEntries([["ink", "ink"], ["bad", "bad"], ["warn", "warn"], ["box", "box"], ["edge", "boxedge"]].map(([name, of]) => [name, floats(of)]));
    this.coloursVersion = (this.coloursVersion ?? 0) + 1;
  }

  // options: {grid: whether cells are drawn, over: whether they are over a map}. The floor is kept in a picture, and
  // floor and lines in another; each is made again when it or the camera changes. Robots are drawn for each frame.
  draw(camera, options) {
    if (this.lost || !this.scene.fleet.map) return;
    const { width, height } = camera;
    const place = placeOf(camera);
    this.#makeStill(camera, place, options);
    this.#copy(this.still, null, width, height);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    this.#drawRobots(this.scene.fleet.map, camera, place);
  }

  // The same without robots; nothing happens while floor, lines and camera stay as they are.
  drawStill(camera, options) {
    if (this.lost || !this.scene.fleet.map || !this.#makeStill(camera, placeOf(camera), options)) return;
    this.#copy(this.still, null, camera.width, camera.height);
  }

  // Return whether the picture was made again.
  #makeStill(camera, place, { grid, over }) {
    const { gl, scene, ground, still } = this;
    const { map } = scene.fleet;
    const { width, height } = camera;
    const floorWanted = `${width} ${height} ${place} ${grid} ${over} ${scene.cellsVersion} ${this.coloursVersion}`;
    const wanted = `${floorWanted} ${scene.linesVersion}`;
    if (still.drawn === wanted) return false;
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    if (ground.drawn !== floorWanted) {
      this.#bind(ground, width, height);
      gl.clear(gl.COLOR_BUFFER_BIT);
      if (grid) this.#drawFloor(map, camera, place, over);
      ground.drawn = floorWanted;
    }
    this.#bind(still, width, height);
    this.#copy(ground, still.frame, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, still.frame);
    this.#drawLines(camera, place);
    still.drawn = wanted;
    return true;
  }

  #copy(from, frame, width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from.frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, frame);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  #bind(still, width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, still.frame);
    if (still.width === width && still.height === height) return;
    Object.assign(still, { width, height });
    gl.bindTexture(gl.TEXTURE_2D, still.picture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, still.picture, 0);
  }

  #drawFloor(map, camera, place, over) {
    const { gl, floor, scene } = this;
    floor.use();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (this.cellsVersion !== scene.cellsVersion) {
      this.cellsVersion = scene.cellsVersion;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, map.columns, map.rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, scene.cells);
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    }
    const yaw = map.yaw ?? 0;
    gl.uniform4fv(floor.at.place, place);
    gl.uniform4f(floor.at.frame, map.origin[0], map.origin[1], Math.cos(yaw), Math.sin(yaw));
    gl.uniform3f(floor.at.grid, map.columns, map.rows, map.cell_size);
    gl.uniform1f(floor.at.side, map.cell_size * camera.scale);
    gl.uniform1f(floor.at.over, over ? 1 : 0);
    gl.uniform3fv(floor.at["colours[0]"], this.floorColours);
    gl.uniform1i(floor.at.cells, 0);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  #drawLines(camera, place) {
    const { gl, line, scene } = this;
    if (this.linesVersion !== scene.linesVersion) {
      this.linesVersion = scene.linesVersion;
      this.lines.fill(scene.lines, scene.lineCount);
    }
    line.use();
    gl.uniform4fv(line.at.place, place);
    gl.uniform2f(line.at.screen, camera.width / 2, camera.height / 2);
    gl.uniform1f(line.at.ratio, devicePixelRatio);
    this.lines.draw();
  }

  #drawRobots(map, camera, place) {
    const { gl, robot, scene } = this;
    this.robots.fill(scene.robots, scene.robotCount);
    robot.use();
    gl.uniform4fv(robot.at.place, place);
    gl.uniform2f(robot.at.screen, camera.width / 2, camera.height / 2);
    gl.uniform1f(robot.at.radius, Math.max(LEAST_ROBOT_PX * devicePixelRatio, (map.robot_radius ?? 0.25) * camera.scale));
    for (const name in this.colours) gl.uniform3fv(robot.at[name], this.colours[name]);
    this.robots.draw();
  }
}
