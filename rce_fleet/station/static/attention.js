// What needs the operator, worst first, each with the answers that fit.

import { exceptionsOf, fleetConditionsOf, isPossible, loadCells, rowsOf, taskConditionsOf } from "./conditions.js";
import { element } from "./engine.js";
import { isPressed, placeRows } from "./rows.js";
import { t } from "./texts.js";

const DRAW_EVERY_MS = 1000;
const MOST = 20;
const MORE = 100;
const MOST_NAMES = 100;

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
  #most = MOST; // rows that are shown
  #open = new Set(); // kinds of groups whose robots are shown

  // answer: (name, robot) => does it; answerTask: (name, task, cell)
  constructor(fleet, work, answer, answerTask) {
    this.fleet = fleet;
    this.work = work;
    this.answer = answer;
    this.answerTask = answerTask;
    this.steers = true;
    this.list = document.querySelector("#attention-list");
    this.count = document.querySelector("#attention-count");
    setInterval(() => this.draw(), DRAW_EVERY_MS);
    for (const type of ["control", "planner"]) fleet.addEventListener(type, () => this.draw());
    work.addEventListener("change", () => this.draw());
  }

  draw() {
    if (isPressed(this.list)) return;
    const whole = fleetConditionsOf(this.fleet);
    const found = exceptionsOf([...this.fleet.robots.values(), ...this.fleet.unknownUndelivered()]);
    const tasks = taskConditionsOf(this.work);
    this.count.textContent = whole.length + found.length + tasks.length || "";
    const rows = [...rowsOf(found, this.fleet.stoppedBy !== null), ...tasks].sort((a, b) => b.conditions[0].severity - a.conditions[0].severity);
    if (rows.length <= MOST) this.#most = MOST;
    const shown = rows.slice(0, this.#most);
    const hidden = rows.slice(this.#most).reduce((count, { robots }) => count + (robots?.length ?? 1), 0);
    const before = new Map([...this.list.children].map((item) => [item.dataset.key, item]));
    // An item is made again only when something else than the text of its conditions changes.
    const item = (parts, make) => {
      const key = JSON.stringify(parts);
      const known = before.get(key) ?? make();
      known.dataset.key = key;
      return known;
    };
    const items = whole.map(({ text }) => item(["whole", text], () => this.#line([text])));
    for (const row of shown) {
      const made = item(this.#partsOf(row), () => this.#row(row));
      made.querySelector(".why").textContent = row.conditions.map(({ text }) => text).join("; ");
      items.push(made);
    }
    if (hidden) items.push(item(["more", hidden], () => this.#moreItem(hidden)));
    if (!items.length) items.push(item(["none"], () => element("li", t("attention.none"), "quiet")));
    this.#place(items);
  }

  // What an item is made from, but for the text of its conditions.
  #partsOf({ robots, task, conditions }) {
    const subject = task ? [task.id, task.robot_assigned, task.rounds, loadCells(task, this.fleet.robots)] : robots.map(({ id }) => id);
    return [this.steers, this.fleet.manager, subject, conditions.map(({ kind, severity }) => [kind, severity])];
  }

  // Show the items; a button that is moved or made again keeps the focus.
  #place(items) {
    const focused = this.list.contains(document.activeElement) ? document.activeElement : null;
    placeRows(this.list, items);
    if (!focused || document.activeElement === focused) return;
    const again = [...this.list.querySelectorAll("[data-answer]")].find(({ dataset }) => dataset.answer === focused.dataset.answer);
    (focused.isConnected ? focused : again)?.focus();
  }

  #row(row) {
    if (row.task) return this.#taskItem(row);
    return row.robots.length > 1 ? this.#group(row) : this.#item(row);
  }

  #line(content, isSevere = true) {
    const item = element("li", "", isSevere ? "severe" : "mild");
    const sign = element("span", isSevere ? "!!" : "!", "sign");
    sign.setAttribute("aria-hidden", "true");
    item.append(sign, ...content);
    return item;
  }

  #moreItem(count) {
    const item = element("li", "", "quiet");
    const button = element("button", t("attention.more", { count }), "link");
    button.type = "button";
    button.dataset.answer = "more";
    button.addEventListener("click", () => {
      this.#most += MORE;
      this.draw();
    });
    item.append(button);
    return item;
  }

  // Robots that one stop of the whole fleet concerns: one answer for all, the robots on demand.
  #group({ robots, conditions: [{ kind, severity, text }] }) {
    const details = element("details");
    details.open = this.#open.has(kind);
    const summary = element("summary", t("attention.group", { count: robots.length }));
    summary.dataset.answer = `group ${kind}`;
    summary.append(" ", element("span", text, "why"));
    details.append(summary);
    const fill = () => {
      if (!details.open || details.childElementCount > 1) return;
      for (const { id } of robots.slice(0, MOST_NAMES)) details.append(this.#name(id), " ");
      if (robots.length > MOST_NAMES) details.append(element("span", t("attention.more", { count: robots.length - MOST_NAMES }), "quiet"));
    };
    details.addEventListener("toggle", () => {
      if (details.isConnected) this.#open[details.open ? "add" : "delete"](kind);
      fill();
    });
    fill();
    const item = this.#line([details], severity > 2);
    if (this.steers) {
      const row = element("div", "", "answers");
      const answers = kind === "undelivered" ? [["stopAll", "stop.all"], ["releaseAll", "stop.releaseAll"]] : [["releaseAll", "stop.releaseAll"]];
      for (const [answer, label] of answers) {
        const button = element("button", t(label));
        button.type = "button";
        button.dataset.answer = `${answer} ${kind}`;
        button.addEventListener("click", () => this.answer(answer, null));
        row.append(button);
      }
      item.append(row);
    }
    return item;
  }

  #name(id) {
    const name = element("button", id, "link");
    name.type = "button";
    name.dataset.answer = `show ${id}`;
    name.addEventListener("click", () => this.answer("show", id));
    return name;
  }

  #item({ robots: [robot], conditions }) {
    const name = this.#name(robot.id);
    const why = element("span", conditions.map(({ text }) => text).join("; "), "why");
    const item = this.#line([name, " ", why], conditions[0].severity > 2);
    if (this.steers) {
      const row = element("div", "", "answers");
      const names = [...new Set(conditions.flatMap(({ kind }) => ANSWERS[kind] ?? []))].filter((name) => isPossible(name, this.fleet, robot.id));
      for (const answer of names) {
        const button = element("button", t(`action.${answer}`));
        button.type = "button";
        button.dataset.answer = `${answer} ${robot.id}`;
        button.setAttribute("aria-label", `${t(`action.${answer}`)}: ${robot.id}`);
        button.addEventListener("click", () => this.answer(answer, robot.id));
        row.append(button);
      }
      item.append(row);
    }
    return item;
  }

  // A task that no robot goes on with, with the answers that fit.
  #taskItem({ task, conditions: [{ kind, severity, text }] }) {
    const item = this.#line([element("b", task.id), " ", element("span", text, "why")], severity > 2);
    if (!this.steers) return item;
    const row = element("div", "", "answers");
    const add = (answer, label, cell = null) => {
      const button = element("button", label);
      button.type = "button";
      button.dataset.answer = `${answer} ${cell} ${task.id}`;
      button.setAttribute("aria-label", `${label}: ${task.id}`);
      button.addEventListener("click", () => this.answerTask(answer, task.id, cell));
      row.append(button);
    };
    if (kind === "load") {
      for (const [cell, where] of loadCells(task, this.fleet.robots)) add("loadAt", t(`action.load.${where}`, { cell, robot: task.robot_assigned }), cell);
      if (task.rounds === 1) add("loadPlace", t("action.loadPlace"));
      add("loadLost", t("action.loadLost"));
    } else for (const answer of ["raise", "cancel"]) add(answer, t(`action.${answer}`));
    item.append(row);
    return item;
  }
}
