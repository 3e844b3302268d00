// Pointers on a canvas: wheel and pinch zoom, a drag pans or belongs to the tool, a short press is a click.

const CLICK_PX = 5;      // a pointer that moved less than this is a click
const WHEEL = 0.0015;    // zoom for each unit of a wheel
const STEP = 1.25;       // zoom for each press of + or -
const PAN_SHARE = 0.15;  // of the screen for each arrow key with Shift

export class Gestures {
  #pointers = new Map(); // id -> [x, y], CSS pixels
  #start = null;
  #dragging = false;
  #owned = false;        // whether the tool has the drag
  #pinched = false;

  // tool: {begin(event) => whether the tool takes the drag, move(event), end(event), click(event), hover(event), leave(), cancel()}
  constructor(canvas, camera, tool) {
    this.canvas = canvas;
    this.camera = camera;
    this.tool = tool;
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => this.#cancel(event));
    canvas.addEventListener("pointerleave", () => { if (!this.#pointers.size) tool.leave(); });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", (event) => event.preventDefault());
  }

  // Whether a key zoomed or panned.
  key(event) {
    const { camera } = this;
    const pans = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.key === "+" || event.key === "=") camera.zoom(STEP);
    else if (event.key === "-") camera.zoom(1 / STEP);
    else if (event.key === "0") camera.fit();
    else if (event.shiftKey && event.key in pans) {
      const [x, y] = pans[event.key];
      camera.pan(x * PAN_SHARE * camera.width, y * PAN_SHARE * camera.height);
    } else return false;
    return true;
  }

  get #ratio() {
    return this.canvas.width / this.canvas.getBoundingClientRect().width;
  }

  #place(x, y) {
    const box = this.canvas.getBoundingClientRect();
    return [(x - box.left) * this.#ratio, (y - box.top) * this.#ratio];
  }

  #wheel(event) {
    event.preventDefault();
    const unit = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
    this.camera.zoom(Math.exp(-event.deltaY * unit * WHEEL), ...this.#place(event.clientX, event.clientY));
  }

  #down(event) {
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.canvas.setPointerCapture(event.pointerId);
    if (this.#pointers.size > 1) {
      if (this.#owned) this.tool.cancel();
      this.#owned = false;
      this.#pinched = true;
      return;
    }
    this.#start = [event.clientX, event.clientY];
    this.#dragging = this.#pinched = false;
    this.#owned = event.button === 0 && this.tool.begin(event);
  }

  #move(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return this.tool.hover(event);
    if (this.#pinched) return this.#pinch(event, before);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const far = Math.hypot(event.clientX - this.#start[0], event.clientY - this.#start[1]);
    this.#dragging ||= far >= CLICK_PX;
    if (!this.#dragging) return;
    if (this.#owned) return this.tool.move(event);
    this.camera.pan((event.clientX - before[0]) * this.#ratio, (event.clientY - before[1]) * this.#ratio);
  }

  // Two pointers: their distance zooms, their middle pans.
  #pinch(event, before) {
    const other = [...this.#pointers].find(([id]) => id !== event.pointerId)?.[1];
    const now = [event.clientX, event.clientY];
    this.#pointers.set(event.pointerId, now);
    if (!other) return;
    const middle = (one) => [(one[0] + other[0]) / 2, (one[1] + other[1]) / 2];
    const [was, is] = [middle(before), middle(now)];
    this.camera.pan((is[0] - was[0]) * this.#ratio, (is[1] - was[1]) * this.#ratio);
    const distance = (one) => Math.max(1, Math.hypot(one[0] - other[0], one[1] - other[1]));
    this.camera.zoom(distance(now) / distance(before), ...this.#place(...is));
  }

  #up(event) {
    if (!this.#pointers.delete(event.pointerId) || this.#pinched) return;
    if (this.#owned && this.#dragging) this.tool.end(event);
    else if (!this.#dragging && event.button === 0) this.tool.click(event);
    else if (this.#owned) this.tool.cancel();
    this.#owned = false;
  }

  #cancel(event) {
    this.#pointers.delete(event.pointerId);
    if (this.#owned) this.tool.cancel();
    this.#owned = false;
  }
}
