// What a drawing with WebGL 2 needs: programs, many items of one shape, uniforms.

export function makeContext(canvas) {
  return canvas.getContext("webgl2", { alpha: true, antialias: false, premultipliedAlpha: true, powerPreference: "low-power" });
}

// Whether WebGL 2 is there, and draws without a graphics card.
export function isSoftware() {
  const probe = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!probe) return makeContext(document.createElement("canvas")) !== null;
  const facts = probe.getExtension("WEBGL_debug_renderer_info");
  const name = facts ? probe.getParameter(facts.UNMASKED_RENDERER_WEBGL) : "";
  probe.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function shader(gl, type, source) {
  const made = gl.createShader(type);
  gl.shaderSource(made, `#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n${source}`);
  gl.compileShader(made);
  if (!gl.getShaderParameter(made, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(made));
  return made;
}

// A program with its uniforms' places: {use(), at: {name: place}}.
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  gl.attachShader(made, shader(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(made, shader(gl, gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let index = 0; index < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); index++) {
    const { name } = gl.getActiveUniform(made, index);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { use: () => gl.useProgram(made), at };
}

const ROW_TEXELS = 1020; // a multiple of 2 and 3, so that an item is never in two rows

// The numbers of an item, for a vertex shader: part(item, 0) has its first four, part(item, 1) the next four.
export function itemParts(texels) {
  return `uniform sampler2D items;
vec4 part(int item, int which) {
  int at = item * ${texels} + which;
  return texelFetch(items, ivec2(at % ${ROW_TEXELS}, at / ${ROW_TEXELS}), 0);
}`;
}

// Room for the numbers of some items in whole rows of a texture; what was there before stays.
export function roomFor(numbers, count, texels) {
  const row = 4 * ROW_TEXELS;
  const needed = Math.max(1, Math.ceil((4 * texels * count) / row)) * row;
  if (needed <= numbers.length) return numbers;
  const larger = new Float32Array(Math.max(needed, 2 * numbers.length));
  larger.set(numbers);
  return larger;
}

// Colours are stored as one number, which a float32 holds exactly.
export const packed = ([red, green, blue]) => red + 256 * green + 65536 * blue;
export const UNPACK = "vec3 unpack(float n) { return vec3(mod(n, 256.0), mod(floor(n / 256.0), 256.0), floor(n / 65536.0)) / 255.0; }";

// Many items of one shape, drawn by one call; their numbers are in a texture. Instances would be slow: a renderer
// without a graphics card sets up each of them as a drawing of its own.
export class Items {
  count = 0;
  #rows = 0;

  constructor(gl, texels) {
    this.gl = gl;
    this.texels = texels;
    this.nothing = gl.createVertexArray();
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  }

  // numbers: of the items one after the other, with the room that roomFor gives.
  fill(numbers, count) {
    const { gl } = this;
    this.count = count;
    if (!count) return;
    const rows = Math.ceil((count * this.texels) / ROW_TEXELS);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (rows > this.#rows) {
      this.#rows = Math.ceil(rows * 1.5);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, ROW_TEXELS, this.#rows, 0, gl.RGBA, gl.FLOAT, null);
    }
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW_TEXELS, rows, gl.RGBA, gl.FLOAT, numbers, 0);
  }

  // Draw each item with some vertices, a multiple of 3: gl_VertexID counts them through all items.
  draw(vertices = 6) {
    const { gl } = this;
    if (!this.count) return;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, vertices * this.count);
  }
}
