// Driving a robot by hand: keys, a gamepad or the stick on the screen, with a dead-man's switch and the latency shown.

import { heartbeatAge, OFFLINE_S } from "./conditions.js";
import { t } from "./texts.js";

const FRAME_MS = 80;
const SPEED = 0.35;      // metres per second
const TURN = 0.9;        // radians per second
const LATE_S = 0.5;      // without an answer for this time nothing is sent but a stop
const DEAD_ZONE = 0.12;  // of a gamepad's stick
const KEYS = { ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0], ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1] };

export class Drive {
  robot = null;
  #socket = null;
  #keys = new Set();
  #stick = null;         // [forward, left], -1 to 1, while the stick is held
  #held = false;         // the button on the screen, or the space bar
  #number = 0;
  #sent = new Map();     // number -> when
  #roundTrip = 0;
  #robotRoundTrip = null;  // from the station to the robot, seconds; null: it does not answer
  #answered = 0;

  constructor(fleet) {
    this.fleet = fleet;
    this.box = document.querySelector("#drive");
    this.title = document.querySelector("#drive-robot");
    this.state = document.querySelector("#drive-state");
    this.latency = document.querySelector("#drive-latency");
    this.pad = document.querySelector("#drive-pad");
    this.knob = document.querySelector("#drive-knob");
    document.querySelector("#drive-end").addEventListener("click", () => this.end());
    const hold = document.querySelector("#drive-hold");
    hold.addEventListener("pointerdown", (event) => { hold.setPointerCapture(event.pointerId); this.#hold(true); });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) hold.addEventListener(type, () => this.#hold(false));
    this.holdButton = hold;
    this.box.addEventListener("keydown", (event) => this.#key(event, true));
    this.box.addEventListener("keyup", (event) => this.#key(event, false));
    this.box.addEventListener("focusout", (event) => { if (!this.box.contains(event.relatedTarget)) this.#release(); });
    window.addEventListener("blur", () => this.#release());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.#release(); });
    this.pad.addEventListener("pointerdown", (event) => { this.pad.setPointerCapture(event.pointerId); this.#move(event); });
    this.pad.addEventListener("pointermove", (event) => { if (this.#stick) this.#move(event); });
    for (const type of ["pointerup", "pointercancel"]) this.pad.addEventListener(type, () => { this.#stick = null; this.#drawKnob(0, 0); });
  }

  begin(robot) {
    this.end();
    this.robot = robot;
    this.title.textContent = t("drive.title", { robot });
    this.state.textContent = t("drive.connecting");
    this.box.hidden = false;
    this.box.focus();
    this.box.scrollIntoView({ block: "nearest" });
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/robots/${encodeURIComponent(robot)}/drive`);
    this.#socket = socket;
    this.#number = 0;
    this.#sent.clear();
    this.#answered = performance.now();
    this.#roundTrip = 0;
    this.#robotRoundTrip = null;
    this.error = null;
    // A socket of an earlier drive may close, or tell something, while the next one drives.
    const isMine = () => this.#socket === socket;
    let timer = null;
    socket.addEventListener("message", ({ data }) => { if (isMine()) this.#take(JSON.parse(data)); });
    socket.addEventListener("close", () => {
      clearInterval(timer);
      if (isMine()) this.state.textContent = this.error ?? t("drive.ended");
    });
    socket.addEventListener("open", () => { timer = setInterval(() => { if (isMine()) this.#send(); }, FRAME_MS); });
  }

  end() {
    this.#release();
    const socket = this.#socket;
    this.#socket = null;
    this.robot = null;
    socket?.close();
    this.box.hidden = true;
  }

  #take(answer) {
    if (answer.error) {
      this.error = answer.error;
      this.state.textContent = answer.error;
      return;
    }
    const sent = this.#sent.get(answer.number);
    for (const number of this.#sent.keys()) if (number <= answer.number) this.#sent.delete(number);
    this.#answered = performance.now();
    if (sent !== undefined) this.#roundTrip = (this.#answered - sent) / 1000;
    this.#robotRoundTrip = answer.robot_round_trip ?? null;
    this.#showLatency();
    this.state.textContent = answer.reason || t("drive.drives", { speed: answer.speed.toFixed(2), turn: answer.turn_rate.toFixed(2) });
    this.state.className = answer.reason ? "warn" : "good";
  }

  // Of a robot that does not answer only its last sign of life, which the planner heard, is known.
  #showLatency() {
    const robot = this.fleet.robots.get(this.robot);
    const age = robot ? heartbeatAge(robot) : null;
    const ms = (seconds) => Math.round(1000 * seconds);
    const on = this.#robotRoundTrip;
    this.latency.textContent = [
      t("drive.latency", { ms: ms(this.#roundTrip) }),
      on === null ? t("drive.latency.unmeasured") : t("drive.latency.robot", { ms: ms(on) }),
      age === null ? t("drive.latency.unheard") : t("drive.latency.heard", { seconds: age.toFixed(1) }),
    ].join("; ");
    this.latency.className = this.#roundTrip + (on ?? 0) > LATE_S / 2 || age === null || age > OFFLINE_S ? "bad" : "quiet";
  }

  #send() {
    if (this.#socket?.readyState !== WebSocket.OPEN) return;
    const now = performance.now();
    const late = this.#sent.size > 0 && now - this.#answered > 1000 * LATE_S;
    const [forward, left, held] = this.#wanted();
    const frame = { number: this.#number, sent: now / 1000, held: held && !late, speed: forward * SPEED, turn_rate: left * TURN, round_trip: this.#roundTrip };
    this.#sent.set(this.#number++, now);
    this.#socket.send(JSON.stringify(frame));
    if (late) this.state.textContent = t("drive.late");
  }

  // [forward, left, whether the dead-man's switch is held]. A gamepad's state is old while the page is not in focus.
  #wanted() {
    if (document.hidden || !document.hasFocus()) return [0, 0, false];
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected);
    if (pad && (pad.buttons[4]?.pressed || pad.buttons[5]?.pressed)) {
      const axis = (value) => (Math.abs(value) < DEAD_ZONE ? 0 : value);
      return [-axis(pad.axes[1] ?? 0), -axis(pad.axes[0] ?? 0), true];
    }
    if (this.#stick) return [...this.#stick, true];
    let [forward, left] = [0, 0];
    for (const key of this.#keys) {
      forward += KEYS[key][0];
      left += KEYS[key][1];
    }
    return [Math.sign(forward), Math.sign(left), this.#held];
  }

  #key(event, down) {
    if (event.code === "Escape") return this.end();
    if (event.code === "Space") this.#hold(down);
    else if (event.code in KEYS) down ? this.#keys.add(event.code) : this.#keys.delete(event.code);
    else return;
    event.preventDefault();
  }

  #hold(on) {
    this.#held = on;
    this.holdButton.setAttribute("aria-pressed", on);
  }

  #release() {
    this.#keys.clear();
    this.#stick = null;
    this.#hold(false);
    this.#drawKnob(0, 0);
  }

  #move(event) {
    const box = this.pad.getBoundingClientRect();
    const clip = (value) => Math.max(-1, Math.min(1, value));
    const right = clip((2 * (event.clientX - box.left)) / box.width - 1);
    const down = clip((2 * (event.clientY - box.top)) / box.height - 1);
    this.#stick = [-down, -right];
    this.#drawKnob(right, down);
  }

  #drawKnob(right, down) {
    this.knob.style.transform = `translate(${38 * right}px, ${38 * down}px)`;
  }
}
