// What needs the operator, worst first, each with the answers that fit.

import { exceptionsOf, fleetConditionsOf, isPossible } from "./conditions.js";
import { element } from "./engine.js";
import { t } from "./texts.js";

const DRAW_EVERY_MS = 1000;
const MOST = 20;

const ANSWERS = {
  undelivered: ["stop", "release"],
  emergency: ["release"],
  offline: ["takeOut", "reassign"],
  stuck: ["cancel", "reassign", "drive", "takeOut"],
  lost: ["localize", "drive", "stop"],
  battery: ["charge", "takeOut"],
  deadline: ["raise", "reassign", "cancel"],
};

export class Attention {
  #drawn = "";

  // answer: (name, robot) => does it
  constructor(fleet, answer) {
    this.fleet = fleet;
    this.answer = answer;
    this.steers = true;
    this.list = document.querySelector("#attention-list");
    this.count = document.querySelector("#attention-count");
    setInterval(() => this.draw(), DRAW_EVERY_MS);
    for (const type of ["control", "planner"]) fleet.addEventListener(type, () => this.draw());
  }

  draw() {
    const whole = fleetConditionsOf(this.fleet);
    const found = exceptionsOf([...this.fleet.robots.values(), ...this.fleet.unknownUndelivered()]);
    this.count.textContent = whole.length + found.length || "";
    const shown = found.slice(0, MOST);
    // Rebuilt only when something else is to be shown, so that a button keeps its focus.
    const key = JSON.stringify([this.steers, this.fleet.manager, whole, found.length, shown.map(({ robot, conditions }) => [robot.id, conditions.map(({ kind }) => kind)])]);
    if (key === this.#drawn) {
      shown.forEach(({ conditions }, index) => { this.list.children[whole.length + index].querySelector(".why").textContent = conditions.map(({ text }) => text).join("; "); });
      return;
    }
    this.#drawn = key;
    this.list.replaceChildren(...whole.map(({ text }) => this.#line([text])), ...shown.map((one) => this.#item(one)));
    if (found.length > MOST) this.list.append(element("li", t("attention.more", { count: found.length - MOST }), "quiet"));
    if (!whole.length && !found.length) this.list.append(element("li", t("attention.none"), "quiet"));
  }

  #line(content, isSevere = true) {
    const item = element("li", "", isSevere ? "severe" : "mild");
    const sign = element("span", isSevere ? "!!" : "!", "sign");
    sign.setAttribute("aria-hidden", "true");
    item.append(sign, ...content);
    return item;
  }

  #item({ robot, conditions }) {
    const name = element("button", robot.id, "link");
    name.type = "button";
    name.addEventListener("click", () => this.answer("show", robot.id));
    const why = element("span", conditions.map(({ text }) => text).join("; "), "why");
    const item = this.#line([name, " ", why], conditions[0].severity > 2);
    if (this.steers) {
      const row = element("div", "", "answers");
      const names = [...new Set(conditions.flatMap(({ kind }) => ANSWERS[kind] ?? []))].filter((name) => isPossible(name, this.fleet));
      for (const answer of names) {
        const button = element("button", t(`action.${answer}`));
        button.type = "button";
        button.setAttribute("aria-label", `${t(`action.${answer}`)}: ${robot.id}`);
        button.addEventListener("click", () => this.answer(answer, robot.id));
        row.append(button);
      }
      item.append(row);
    }
    return item;
  }
}
