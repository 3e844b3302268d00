// The selected robot: its state, and what can be done with it.

import { element } from "./engine.js";
import { heartbeatAge, isOut, isPossible } from "./conditions.js";
import { isPressed } from "./rows.js";
import { t } from "./texts.js";

const ANSWERS = ["drive", "localize", "charge", "reassign", "cancel"];

export class RobotCard {
  steers = true;

  constructor(fleet, answer) {
    this.fleet = fleet;
    this.answer = answer;
    this.box = document.querySelector("#robot-card");
    for (const type of ["selected", "state", "changes", "control", "manager"]) fleet.addEventListener(type, () => this.draw());
    setInterval(() => this.draw(), 1000);
  }

  draw() {
    if (isPressed(this.box)) return;
    const robot = this.fleet.robots.get(this.fleet.selected);
    this.box.hidden = !robot || !this.steers;
    if (this.box.hidden) return;
    const paused = ["paused", "stopped"].includes(robot.ownMode); // a robot of a paused fleet is not, and cannot be resumed
    const out = isOut(robot);
    const stops = [...(robot.emergency && !robot.undelivered ? [] : ["stop"]), ...(robot.emergency ? ["release"] : [])];
    const names = [...stops, paused ? "resume" : "pause", out ? "putIn" : "takeOut", ...ANSWERS].filter((name) => isPossible(name, this.fleet, robot.id));
    const key = [robot.id, ...names].join();
    if (key !== this.key) {
      this.key = key;
      this.title = element("h3", robot.id);
      this.text = element("p", "", "quiet");
      const row = element("div", "", "answers");
      for (const name of names) {
        const button = element("button", t(`action.${name}`), name === "stop" ? "stop" : "");
        button.type = "button";
        button.addEventListener("click", () => this.answer(name, robot.id));
        row.append(button);
      }
      this.box.replaceChildren(this.title, row, this.text); // the text's length does not move the buttons
    }
    const age = heartbeatAge(robot);
    const parts = [robot.undelivered && t("condition.undelivered", { user: robot.emergency }), robot.activity ?? robot.state, robot.pose_only && t("robot.poseOnly"), robot.reason, robot.task && `${robot.task}`, robot.loads && t("robot.loads", { count: robot.loads }), Number.isFinite(robot.battery) && `${Math.round(100 * robot.battery)} %`];
    parts.push(age === null ? t("age.never") : t("age.seconds", { seconds: age.toFixed(1) }));
    this.text.textContent = parts.filter(Boolean).join(" \u00b7 ");
  }
}
