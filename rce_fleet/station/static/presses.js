// Clicks go to what was pressed, also if the page has moved it away, or hidden it, before the release: something above
// it grew, or another button took its place. A mouse's click is lost then, and a finger's click hits what is there now.

const CONTROLS = "a, button, label, summary, tr";

export class Presses {
  #pressed = null; // the control, and its box where it was pressed
  #isReleased = false; // within this box: a pointer that is released elsewhere takes its press back

  constructor() {
    for (const type of ["pointerdown", "pointerup", "pointercancel", "click"]) addEventListener(type, this, true);
  }

  handleEvent(event) {
    if (event.type === "click") this.#click(event);
    else if (!event.isPrimary) return;
    else if (event.type === "pointerdown") this.#press(event);
    else this.#isReleased = event.type === "pointerup" && this.#isWithin(event);
  }

  #press(event) {
    const control = event.button === 0 ? event.target.closest(CONTROLS) : null;
    this.#pressed = control && { control, box: control.getBoundingClientRect() };
    this.#isReleased = false;
  }

  #isWithin({ clientX, clientY }) {
    const box = this.#pressed?.box;
    return box && clientX >= box.left && clientX <= box.right && clientY >= box.top && clientY <= box.bottom;
  }

  #click(event) {
    if (!event.isTrusted || event.detail === 0 || !this.#isReleased) return; // detail 0: by a key
    this.#isReleased = false;
    const { control } = this.#pressed;
    if (control.contains(event.target)) return;
    event.stopImmediatePropagation();
    event.preventDefault();
    control.click();
  }
}
