// The manager's tasks, robots, zones and figures, asked for every few seconds; independent of the screen.

import { ask } from "./requests.js";

const EVERY_MS = 2000;
const MOST_TASKS = 200;

export class Work extends EventTarget {
  tasks = new Map();   // id -> task, those that have not ended
  recent = [];         // tasks that ended, the newest first
  zones = [];
  chargers = null;
  statistics = null;
  trouble = "none";    // why there is nothing: no manager, or its error; null while the manager answers
  #timer = null;

  constructor(fleet) {
    super();
    this.fleet = fleet;
    // A request that has no answer is an error in the browser's log: the station tells whether there is a manager.
    fleet.addEventListener("manager", () => this.refresh());
  }

  // Ask at once: the operator did something, or the manager came or went.
  refresh() {
    clearTimeout(this.#timer);
    if (this.fleet.manager) this.#ask();
    else this.#forget();
  }

  // What a manager said that is gone does not hold any more.
  #forget() {
    this.trouble = "none";
    this.tasks.clear();
    this.recent = [];
    this.statistics = null;
    for (const robot of this.fleet.robots.values()) Object.assign(robot, { task: null, activity: null, queue: [], loads: 0, deadlineAtRisk: null });
    this.dispatchEvent(new Event("change"));
  }

  async #ask() {
    try {
      const [robots, open, ended, zones, statistics] = await Promise.all([
        ask("GET", "/robots"),
        ask("GET", `/tasks?state=open&limit=${MOST_TASKS}`),
        ask("GET", "/tasks?state=ended&order=desc&limit=20"),
        ask("GET", "/zones"),
        ask("GET", "/statistics?seconds=3600"),
      ]);
      this.trouble = null;
      this.tasks = new Map(open.tasks.map((task) => [task.id, task]));
      this.recent = ended.tasks;
      this.zones = zones.zones;
      this.statistics = statistics;
      this.#takeRobots(robots.robots);
    } catch (error) {
      this.trouble = error.message;
    }
    this.dispatchEvent(new Event("change"));
    clearTimeout(this.#timer);
    if (this.fleet.manager) this.#timer = setTimeout(() => this.#ask(), EVERY_MS);
  }

  // What the manager knows of robots beside the planner: batteries, tasks, activities.
  #takeRobots(robots) {
    const now = Date.now() / 1000;
    for (const { id, battery, task, activity, queue, loads } of robots) {
      const robot = this.fleet.robots.get(id);
      if (!robot) continue;
      const doing = this.tasks.get(task);
      const late = doing?.deadline && ((doing.expected_end ?? now) > doing.deadline || doing.late);
      Object.assign(robot, { battery, task, activity, queue, loads: loads?.length ?? 0, deadlineAtRisk: late ? task : null });
    }
  }
}
