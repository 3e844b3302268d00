// The last places of a robot, in a ring of numbers: adding one makes no object and moves no other.

export const TRAIL_LENGTH = 240;
const APART_M = 0.05;

export class Trail {
  length = 0;
  #first = 0;
  #numbers = new Float32Array(2 * TRAIL_LENGTH);

  // Add a place, if it is not the last one.
  add(x, y) {
    if (this.length && Math.abs(this.x(this.length - 1) - x) + Math.abs(this.y(this.length - 1) - y) <= APART_M) return;
    if (this.length === TRAIL_LENGTH) this.#first = (this.#first + 1) % TRAIL_LENGTH;
    else this.length++;
    const at = this.#at(this.length - 1);
    this.#numbers[at] = x;
    this.#numbers[at + 1] = y;
  }

  // The place with a number, 0 is the oldest.
  x(index) { return this.#numbers[this.#at(index)]; }
  y(index) { return this.#numbers[this.#at(index) + 1]; }

  #at(index) {
    return 2 * ((this.#first + index) % TRAIL_LENGTH);
  }
}
