// Draws a scene where WebGL has no graphics card: floor and lines with WebGL on a canvas of their own, which rests
// between their changes, and robots as pictures on a canvas above. A frame of robots alone is then cheap.

import { CanvasRenderer } from "./fleet_canvas.js";
import { GlRenderer } from "./fleet_gl.js";

export class SplitRenderer {
  name = "WebGL below, canvas for robots";

  // Throws an error if the browser has no WebGL 2.
  constructor(below, canvas, scene) {
    this.still = new GlRenderer(below, scene);
    this.robots = new CanvasRenderer(canvas, scene);
  }

  readColours(colour) {
    this.still.readColours(colour);
    this.robots.readColours(colour);
  }

  draw(camera, options) {
    this.still.drawStill(camera, options);
    this.robots.drawRobots(camera);
  }
}
