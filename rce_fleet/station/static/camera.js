// Which part of the map is on the screen. World metres, y up; the screen's y points down, its unit is the device's pixel.

const MOST_ZOOM = 400;   // of the scale that shows everything
const LEAST_ZOOM = 0.5;

export class Camera extends EventTarget {
  scale = 1;             // pixels in a metre
  left = 0;              // the screen's x of the map's x = 0
  bottom = 0;            // the screen's y of the map's y = 0
  width = 1;
  height = 1;
  follows = true;        // show everything until the operator zooms or pans
  #bounds = null;
  #fitted = 1;

  x(x) { return this.left + x * this.scale; }
  y(y) { return this.bottom - y * this.scale; }

  worldAt(x, y) {
    return [(x - this.left) / this.scale, (this.bottom - y) / this.scale];
  }

  // The screen has another size: the middle stays where it is.
  resize(width, height) {
    if (width === this.width && height === this.height) return;
    this.left += (width - this.width) / 2;
    this.bottom += (height - this.height) / 2;
    this.width = width;
    this.height = height;
    this.#refit();
  }

  // bounds: [least x, least y, greatest x, greatest y] of the map; margin in metres.
  show(bounds, margin) {
    const [x0, y0, x1, y1] = bounds;
    this.#bounds = [x0 - margin, y0 - margin, x1 + margin, y1 + margin];
    this.#refit();
  }

  fit() {
    this.follows = true;
    this.#refit();
  }

  #refit() {
    if (!this.#bounds) return;
    const [x0, y0, x1, y1] = this.#bounds;
    this.#fitted = Math.min(this.width / (x1 - x0), this.height / (y1 - y0));
    if (this.follows) {
      this.scale = this.#fitted;
      this.left = this.width / 2 - ((x0 + x1) / 2) * this.scale;
      this.bottom = this.height / 2 + ((y0 + y1) / 2) * this.scale;
    }
    this.#changed();
  }

  pan(right, down) {
    this.follows = false;
    this.left += right;
    this.bottom += down;
    this.#changed();
  }

  // Zoom by a factor; the point of the screen stays where it is.
  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const [worldX, worldY] = this.worldAt(x, y);
    this.follows = false;
    this.scale = Math.min(MOST_ZOOM * this.#fitted, Math.max(LEAST_ZOOM * this.#fitted, this.scale * factor));
    this.left = x - worldX * this.scale;
    this.bottom = y + worldY * this.scale;
    this.#changed();
  }

  // Move a point of the map to the middle of the screen.
  centre(x, y) {
    this.pan(this.width / 2 - this.x(x), this.height / 2 - this.y(y));
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}
