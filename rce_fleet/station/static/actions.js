// What an operator can do by one click, each with its undo; where there is none, most ask first.

import { isLight } from "./conditions.js";
import { isCertain } from "./question.js";
import { ask } from "./requests.js";
import { t } from "./texts.js";

// What a task asks for: its fields that a new one has, too.
const ORDER = ["stops", "name", "rounds", "priority", "deadline", "when_late", "earliest_start", "capabilities", "payload", "after", "robot", "return_cells", "repeat"];

const REFUSED = [404, 409, 422]; // of one cell: others can be tried

const CHANGED = 412; // since the revision that a change is for
const CHANGE_TRIES = 5;

// After these, or without any answer, a request may have been carried out.
const UNANSWERED = [undefined, 502, 503, 504];
const AGAIN_MS = [1000, 2000, 4000, 8000, 15000, 30000];

const at = (robot, what) => `/robots/${encodeURIComponent(robot)}/${what}`;

// What a change of a zone is for: this revision of it, and not one that another user made meanwhile; 0: there is none yet.
const ifMatch = (revision) => ({ "If-Match": `"${revision}"` });

export class Actions {
  #keys = new Map(); // orders of tasks that were given up without an answer -> their keys
  #restored = new Map(); // "zone revision" -> the revision at which undo made the zone so again

  constructor(fleet, operator, work) {
    this.fleet = fleet;
    this.operator = operator;
    this.work = work; // the manager's tasks and robots
    this.user = null; // the name of the operator
  }

  #do(key, id, run, undo = null) {
    return this.operator.act(t(`action.${key}.done`, { robot: id }), run, undo);
  }

  // What the robot's own mode is, and why; one that is driven by hand cannot be given back to its driver, and stands.
  #own(id) {
    const { ownMode, ownReason } = this.fleet.robots.get(id) ?? {};
    const mode = ["automatic", "stopped"].includes(ownMode) ? ownMode : "paused";
    return { mode, reason: mode === ownMode && ownReason ? ownReason : "", isManual: ownMode === "manual" };
  }

  pause(id) {
    const undo = this.#own(id).isManual ? null : () => ask("POST", at(id, "resume"));
    return this.#do("pause", id, () => ask("POST", at(id, "pause"), {}), undo);
  }

  resume(id) {
    const { reason } = this.#own(id);
    return this.#do("resume", id, () => ask("POST", at(id, "resume")), () => ask("POST", at(id, "pause"), { reason }));
  }

  takeOut(id) {
    const { mode, reason } = this.#own(id);
    return this.#do("takeOut", id, () => ask("POST", at(id, "take-out"), {}), () => ask("POST", at(id, "put-in"), { mode, reason }));
  }

  putIn(id) {
    const reason = this.fleet.robots.get(id)?.ownReason ?? "";
    return this.#do("putIn", id, () => ask("POST", at(id, "put-in")), () => ask("POST", at(id, "take-out"), { reason }));
  }

  // Without a manager the robot's goal is removed.
  cancel(id) {
    const task = this.fleet.robots.get(id)?.task;
    if (task) return this.cancelTask(task);
    const goal = this.fleet.robots.get(id)?.goal ?? null;
    return this.sendTo(id, null, goal);
  }

  // A task of this operator's that no robot has begun is created again by undo, with another number.
  async cancelTask(id) {
    let task;
    try {
      task = this.work.find(id) ?? this.work.recurring.find((other) => other.id === id) ?? (await ask("GET", `/tasks/${id}`));
    } catch (error) {
      return this.operator.say(error.message, true);
    }
    const hasBegun = task.started_at !== null || task.visits.length > 0 || Boolean(task.repeat);
    const isAwaited = [...this.work.tasks.values()].some(({ after }) => after.includes(id));
    const canUndo = !hasBegun && !isAwaited && task.requester === this.user;
    if (!canUndo && !(await isCertain("cancelTask", { task: id }))) return null;
    const order = Object.fromEntries(ORDER.map((name) => [name, task[name]]));
    const undo = async () => ({ message: t("action.task.made", { task: (await this.#createOnce(order)).id }) });
    return this.operator.act(t("action.cancelTask.done", { task: id }), () => ask("DELETE", `/tasks/${id}`), canUndo ? undo : null);
  }

  holdTask(task) { return this.operator.act(t("action.holdTask.done", { task }), () => ask("POST", `/tasks/${task}/hold`, {}), () => ask("POST", `/tasks/${task}/resume`)); }
  resumeTask(task) { return this.operator.act(t("action.resumeTask.done", { task }), () => ask("POST", `/tasks/${task}/resume`), () => ask("POST", `/tasks/${task}/hold`, {})); }
  raise(task, priority) {
    let before = this.work.find(task)?.priority ?? null;
    const run = async () => {
      before ??= (await ask("GET", `/tasks/${task}`)).priority;
      return ask("PATCH", `/tasks/${task}`, { priority });
    };
    // A task's revision also grows when robots get on with it, so undo compares what the operator changed.
    const undo = async (tries = CHANGE_TRIES) => {
      const now = await ask("GET", `/tasks/${task}`);
      if (now.priority !== priority) throw new Error(t("action.priority.other", { task, priority: now.priority }));
      try {
        return await ask("PATCH", `/tasks/${task}`, { priority: before }, ifMatch(now.revision));
      } catch (error) {
        if (error.status !== CHANGED || tries === 1) throw error;
        return undo(tries - 1);
      }
    };
    return this.operator.act(t("action.priority.done", { task, priority }), run, undo);
  }

  // Give a robot's task to another one; the manager refuses it once the robot has the load.
  async reassign(id) {
    const task = this.fleet.robots.get(id)?.task;
    if (!task) return this.operator.say(t("action.reassign.none", { robot: id }), true);
    if (!(await isCertain("reassign", { task, robot: id }))) return null;
    return this.#do("reassign", id, () => ask("POST", `/tasks/${task}/reassign`));
  }

  // Say where the load of a task is whose robot does not come back; null: it is lost, and the task fails.
  async settleLoad(task, cell) {
    if (cell === null && !(await isCertain("loadLost", { task }))) return null;
    return this.operator.act(t(cell === null ? "action.loadLost.done" : "action.load.done", { task, cell }), () => ask("POST", `/tasks/${task}/load`, { cell }));
  }

  confirmTask(task) { return this.operator.act(t("action.confirmTask.done", { task }), () => ask("POST", `/tasks/${task}/confirm`)); }

  charge(id) { return this.createTask([{ action: "charge" }], { robot: id, priority: 50, name: t("action.charge.name", { robot: id }) }); }

  async createTask(stops, fields = {}) {
    let made = null;
    await this.operator.act(
      t("action.task.done"),
      async () => {
        made = await this.#createOnce({ stops, ...fields });
        return { message: t("action.task.made", { task: made.id }) };
      },
      () => ask("DELETE", `/tasks/${made.id}`),
    );
    return made;
  }

  // A request without an answer is sent again with its key, which makes one task only, also if the operator tries it again later.
  async #createOnce(order) {
    const content = JSON.stringify(order);
    const key = this.#keys.get(content) ?? crypto.randomUUID?.() ?? String(Math.random());
    this.#keys.delete(content);
    for (const pause of [...AGAIN_MS, null]) {
      try {
        return await ask("POST", "/tasks", { ...order, key });
      } catch (error) {
        if (!UNANSWERED.includes(error.status)) throw error;
        if (pause === null) {
          this.#keys.set(content, key);
          throw error;
        }
      }
      this.operator.say(t("action.task.again"), true);
      await new Promise((resolve) => setTimeout(resolve, pause));
    }
    return null;
  }

  sendTo(id, cell, before = this.fleet.robots.get(id)?.goal ?? null) {
    return this.#do("goal", id, () => ask("PUT", at(id, "goal"), { cell }), () => ask("PUT", at(id, "goal"), { cell: before }));
  }

  // Undo sets the pose that the robot would have without it, also if it has driven since.
  setPose(id, x, y, yaw) {
    if (isLight(this.fleet, id)) return this.operator.say(t("action.localize.light", { robot: id }), true);
    const before = this.fleet.robots.get(id)?.pose;
    const old = before && { ...before };
    const undo = () => {
      const now = this.fleet.robots.get(id)?.pose ?? { x, y, theta: yaw };
      const turn = old.theta - yaw;
      const [c, s] = [Math.cos(turn), Math.sin(turn)];
      const [right, up] = [now.x - x, now.y - y];
      const theta = now.theta + turn;
      return ask("PUT", at(id, "pose"), { x: old.x + c * right - s * up, y: old.y + s * right + c * up, yaw: Math.atan2(Math.sin(theta), Math.cos(theta)) });
    };
    return this.#do("localize", id, () => ask("PUT", at(id, "pose"), { x, y, yaw }), old ? undo : null);
  }

  // Many cells at once are one action, whose undo concerns those that were changed. A single cell is always sent, so that a refusal is shown.
  // details: reason and end of cells that are blocked.
  async setCells(cells, blocked, details = {}) {
    const changed = cells.length === 1 ? cells : cells.filter((cell) => !this.fleet.walls.has(cell) && (this.fleet.blocked.has(cell) || this.fleet.pending.has(cell)) !== blocked);
    if (!changed.length) return null;
    const text = (value, count) => t(value ? "action.block.done" : "action.free.done", { count });
    // A cell that is blocked again, as by an undo, keeps reason and end, if no other ones are given.
    const before = new Map(changed.map((cell) => [cell, this.fleet.blocks.get(cell)]));
    const request = (cell) => {
      const { reason, until } = Object.keys(details).length ? details : (before.get(cell) ?? {});
      return { blocked: true, ...(reason && { reason }), ...(until && { until }) };
    };
    const set = async (value, wanted) => {
      const [done, missed] = [[], []];
      let [answer, refusal] = [null, null];
      for (const cell of wanted) {
        try {
          answer = await ask("PUT", `/cells/${cell}`, value ? request(cell) : { blocked: false });
          done.push(cell);
        } catch (error) {
          refusal = error;
          missed.push(cell);
          if (!REFUSED.includes(error.status)) break;
        }
      }
      if (!done.length) throw refusal;
      const left = wanted.length - done.length;
      const message = left ? t("action.cells.part", { label: text(value, done.length), left, cell: missed.at(-1), reason: refusal.message }) : text(value, done.length);
      return { done, missed, message: wanted.length === 1 ? answer.message : message };
    };
    let done = changed; // until it is known which were changed
    const run = async () => {
      const answer = await set(blocked, changed);
      ({ done } = answer);
      return answer;
    };
    return this.operator.act(text(blocked, changed.length), run, () => set(!blocked, done));
  }

  // before: the zone that is replaced; null: it is a new one.
  makeZone(id, zone, before = null) {
    let made = null;
    const run = async () => (made = await this.#putZone(id, zone, before?.revision ?? 0));
    const undo = () => {
      const revision = this.#revisionNow(id, made.revision);
      return before ? this.#restoreZone(before, revision) : this.#dropZone(id, revision);
    };
    return this.operator.act(t("action.zone.done", { zone: id }), run, undo);
  }

  #putZone(id, { kind, cells, value, reason, until = null, edges = [], robots = [] }, revision) {
    return ask("PUT", `/zones/${encodeURIComponent(id)}`, { kind, cells, value, reason, until, edges, robots }, ifMatch(revision));
  }

  async #restoreZone(before, revision) {
    const answer = await this.#putZone(before.id, before, revision);
    this.#restored.set(`${before.id} ${before.revision}`, answer.revision);
    return answer;
  }

  // Undo of earlier actions is for the zone that undo of later ones restored.
  #revisionNow(id, revision) {
    const restored = this.#restored.get(`${id} ${revision}`);
    return restored === undefined ? revision : this.#revisionNow(id, restored);
  }

  async #dropZone(id, revision) {
    await ask("DELETE", `/zones/${encodeURIComponent(id)}`, undefined, ifMatch(revision));
    return { message: t("action.zone.gone", { zone: id }) };
  }

  // zone: as the operator saw it.
  removeZone(zone) {
    return this.operator.act(t("action.zone.gone", { zone: zone.id }), () => this.#dropZone(zone.id, zone.revision), () => this.#restoreZone(zone, 0));
  }

  // A stop takes one click; robots that are released drive on.
  async emergencyStop(id, stopped) {
    if (!stopped && !(await isCertain(id === null ? "releaseAll" : "release", { robot: id }))) return null;
    return this.operator.act(t(stopped ? "stop.done" : "stop.released"), () => ask("PUT", id === null ? "/emergency-stop" : at(id, "emergency-stop"), { stopped }));
  }

  // A fleet that something else than the page stopped cannot be stopped again by undo.
  async setMode(mode) {
    const before = this.fleet.mode;
    const canUndo = ["automatic", "paused"].includes(before);
    if (!canUndo && !(await isCertain("mode", { mode: t(`mode.${before}`) }))) return null;
    return this.operator.act(t(`mode.${mode}`), () => ask("PUT", "/mode", { mode }), canUndo ? () => ask("PUT", "/mode", { mode: before }) : null);
  }
}
