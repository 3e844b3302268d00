// What an operator can do with a robot by one click, each with its undo where there is one.

import { ask } from "./requests.js";
import { t } from "./texts.js";

const at = (robot, what) => `/robots/${encodeURIComponent(robot)}/${what}`;

export class Actions {
  constructor(fleet, operator, work) {
    this.fleet = fleet;
    this.operator = operator;
    this.work = work; // the manager's tasks and robots
  }

  #do(key, id, run, undo = null) {
    return this.operator.act(t(`action.${key}.done`, { robot: id }), run, undo);
  }

  pause(id) { return this.#do("pause", id, () => ask("POST", at(id, "pause"), {}), () => ask("POST", at(id, "resume"))); }
  resume(id) { return this.#do("resume", id, () => ask("POST", at(id, "resume")), () => ask("POST", at(id, "pause"), {})); }
  takeOut(id) { return this.#do("takeOut", id, () => ask("POST", at(id, "take-out"), {}), () => ask("POST", at(id, "put-in"))); }
  putIn(id) { return this.#do("putIn", id, () => ask("POST", at(id, "put-in")), () => ask("POST", at(id, "take-out"), {})); }

  // Without a manager the robot's goal is removed.
  cancel(id) {
    const task = this.fleet.robots.get(id)?.task;
    if (task) return this.cancelTask(task);
    const goal = this.fleet.robots.get(id)?.goal ?? null;
    return this.sendTo(id, null, goal);
  }

  cancelTask(task) { return this.operator.act(t("action.cancelTask.done", { task }), () => ask("DELETE", `/tasks/${task}`)); }
  holdTask(task) { return this.operator.act(t("action.holdTask.done", { task }), () => ask("POST", `/tasks/${task}/hold`, {}), () => ask("POST", `/tasks/${task}/resume`)); }
  resumeTask(task) { return this.operator.act(t("action.resumeTask.done", { task }), () => ask("POST", `/tasks/${task}/resume`), () => ask("POST", `/tasks/${task}/hold`, {})); }
  raise(task, priority) {
    let before = this.work.find(task)?.priority ?? null;
    const run = async () => {
      before ??= (await ask("GET", `/tasks/${task}`)).priority;
      return ask("PATCH", `/tasks/${task}`, { priority });
    };
    return this.operator.act(t("action.priority.done", { task, priority }), run, () => ask("PATCH", `/tasks/${task}`, { priority: before }));
  }

  // Give a robot's task to another one; the manager refuses it once the robot has the load.
  async reassign(id) {
    const task = this.fleet.robots.get(id)?.task;
    if (!task) return this.operator.say(t("action.reassign.none", { robot: id }), true);
    return this.#do("reassign", id, () => ask("POST", `/tasks/${task}/reassign`));
  }

  confirmTask(task) { return this.operator.act(t("action.confirmTask.done", { task }), () => ask("POST", `/tasks/${task}/confirm`)); }

  charge(id) { return this.createTask([{ action: "charge" }], { robot: id, priority: 50, name: t("action.charge.name", { robot: id }) }); }

  async createTask(stops, fields = {}) {
    let made = null;
    await this.operator.act(
      t("action.task.done"),
      async () => {
        made = await ask("POST", "/tasks", { stops, key: crypto.randomUUID?.() ?? String(Math.random()), ...fields });
        return { message: t("action.task.made", { task: made.id }) };
      },
      () => ask("DELETE", `/tasks/${made.id}`),
    );
    return made;
  }

  sendTo(id, cell, before = this.fleet.robots.get(id)?.goal ?? null) {
    return this.#do("goal", id, () => ask("PUT", at(id, "goal"), { cell }), () => ask("PUT", at(id, "goal"), { cell: before }));
  }

  setPose(id, x, y, yaw) { return this.#do("localize", id, () => ask("PUT", at(id, "pose"), { x, y, yaw })); }

  // Only the last click counts for undo: many cells at once are one thing. A single cell is always sent, so that a refusal is shown.
  async setCells(cells, blocked) {
    const changed = cells.length === 1 ? cells : cells.filter((cell) => !this.fleet.walls.has(cell) && (this.fleet.blocked.has(cell) || this.fleet.pending.has(cell)) !== blocked);
    if (!changed.length) return null;
    const set = async (value) => {
      let answer = null;
      for (const cell of changed) answer = await ask("PUT", `/cells/${cell}`, { blocked: value });
      return changed.length === 1 ? answer : { message: t(value ? "action.block.done" : "action.free.done", { count: changed.length }) };
    };
    return this.operator.act(t(blocked ? "action.block.done" : "action.free.done", { count: changed.length }), () => set(blocked), () => set(!blocked));
  }

  // before: the zone that is replaced; null: it is a new one.
  makeZone(id, zone, before = null) {
    return this.operator.act(t("action.zone.done", { zone: id }), () => this.#putZone(id, zone), () => (before ? this.#putZone(id, before) : this.#dropZone(id)));
  }

  #putZone(id, { kind, cells, value, reason, until = null, edges = [], robots = [] }) {
    return ask("PUT", `/zones/${encodeURIComponent(id)}`, { kind, cells, value, reason, until, edges, robots });
  }

  async #dropZone(id) {
    await ask("DELETE", `/zones/${encodeURIComponent(id)}`);
    return { message: t("action.zone.gone", { zone: id }) };
  }

  removeZone(id) {
    const before = this.work.zones.find((zone) => zone.id === id);
    return this.operator.act(t("action.zone.gone", { zone: id }), () => this.#dropZone(id), () => this.#putZone(id, before));
  }

  emergencyStop(id, stopped) {
    return this.operator.act(t(stopped ? "stop.done" : "stop.released"), () => ask("PUT", id === null ? "/emergency-stop" : at(id, "emergency-stop"), { stopped }));
  }

  setMode(mode) {
    const other = mode === "paused" ? "automatic" : "paused";
    return this.operator.act(t(`mode.${mode}`), () => ask("PUT", "/mode", { mode }), () => ask("PUT", "/mode", { mode: other }));
  }
}
