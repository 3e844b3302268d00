// The manager's tasks, robots, zones and figures, asked for every few seconds; independent of the screen.

import { isAtRisk } from "./conditions.js";
import { ask } from "./requests.js";

const EVERY_MS = 2000;
const MOST_TASKS = 200;
// Tasks of robots are read beside them if there are more: so many in a page, and so many pages.
const ROBOTS_TASKS = "running,suspended,cancelling,held,assigned";
const PAGE = 1000;
const MOST_PAGES = 5;

// Tasks without a robot are watched if their deadline comes within this time, seconds.
const WATCHED_S = 3600;

export const ENDED = ["done", "failed", "cancelled"];

export class Work extends EventTarget {
  tasks = new Map();   // id -> task, those that have not ended; the first ones if there are many
  openCount = 0;       // how many have not ended
  recent = [];         // other tasks that ended, the newest first
  recurring = [];      // tasks that ended, and of which another occurrence follows
  questions = [];      // tasks of which people have to decide where their load is
  atRisk = [];         // tasks that no robot does, and that will probably miss their deadlines
  zones = [];
  chargers = null;
  statistics = null;
  trouble = "none";    // why there is nothing: no manager, or its error; null while the manager answers
  #robotsTasks = new Map(); // id -> task: those of robots that are not among the first ones
  #robots = new Map();      // id -> robot, as the manager knows it
  #version = 0;             // of these robots: only those that change after it are asked for
  #timer = null;

  constructor(fleet) {
    super();
    this.fleet = fleet;
    // A request that has no answer is an error in the browser's log: the station tells whether there is a manager.
    fleet.addEventListener("manager", () => this.refresh());
  }

  // A task that a robot does, or that is listed; undefined: another one.
  find(id) {
    return this.tasks.get(id) ?? this.#robotsTasks.get(id);
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
    this.#robotsTasks.clear();
    this.#robots.clear();
    this.#version = 0;
    this.openCount = 0;
    this.recent = [];
    this.recurring = [];
    this.questions = [];
    this.atRisk = [];
    this.statistics = null;
    for (const robot of this.fleet.robots.values()) Object.assign(robot, { task: null, activity: null, ownMode: null, ownReason: "", queue: [], loads: 0, deadlineAtRisk: null });
    this.dispatchEvent(new Event("change"));
  }

  async #ask() {
    try {
      const soon = Math.round(Date.now() / 1000) + WATCHED_S;
      const [robots, open, ended, recurring, due, waiting, zones, statistics] = await Promise.all([
        ask("GET", `/robots?since=${this.#version}`),
        ask("GET", `/tasks?state=open&limit=${MOST_TASKS}`),
        ask("GET", "/tasks?state=ended&order=desc&limit=20"),
        ask("GET", `/tasks?state=recurring&limit=${MOST_TASKS}`),
        ask("GET", `/tasks?state=queued,assigned,held&deadline_before=${soon}&limit=${MOST_TASKS}`),
        ask("GET", `/tasks?state=suspended,cancelling&limit=${PAGE}`),
        ask("GET", "/zones"),
        ask("GET", "/statistics?seconds=3600"),
      ]);
      for (const robot of robots.robots) this.#robots.set(robot.id, robot);
      this.#version = robots.version ?? 0;
      const tasks = new Map(open.tasks.map((task) => [task.id, task]));
      const done = new Set([...this.#robots.values()].map(({ task }) => task));
      const missing = new Set([...done].filter((task) => task && !tasks.has(task)));
      this.#robotsTasks = await this.#readTasks(missing);
      this.trouble = null;
      this.tasks = tasks;
      this.openCount = open.next === null ? tasks.size : Math.max(tasks.size + 1, statistics.tasks_open);
      this.recurring = recurring.tasks.filter(({ state }) => ENDED.includes(state));
      this.recent = ended.tasks.filter(({ recurs_at: next }) => !next);
      this.questions = waiting.tasks.filter(({ question }) => question);
      this.atRisk = due.tasks.filter((task) => isAtRisk(task) && !done.has(task.id));
      this.zones = zones.zones;
      this.statistics = statistics;
      this.#takeRobots();
    } catch (error) {
      this.trouble = error.message;
    }
    this.dispatchEvent(new Event("change"));
    clearTimeout(this.#timer);
    if (this.fleet.manager) this.#timer = setTimeout(() => this.#ask(), EVERY_MS);
  }

  // Tasks by their ids; one that ended meanwhile is missing.
  async #readTasks(ids) {
    const found = new Map();
    let cursor = "";
    for (let page = 0; page < MOST_PAGES && cursor !== null && found.size < ids.size; page++) {
      const { tasks, next } = await ask("GET", `/tasks?state=${ROBOTS_TASKS}&limit=${PAGE}&cursor=${cursor}`);
      for (const task of tasks) if (ids.has(task.id)) found.set(task.id, task);
      cursor = next;
    }
    return found;
  }

  // What the manager knows of robots beside the planner: batteries, tasks, activities, and their own modes, which
  // stay as they are while the whole fleet is paused.
  #takeRobots() {
    for (const { id, battery, task, activity, mode, mode_reason: ownReason, queue, loads } of this.#robots.values()) {
      const robot = this.fleet.robots.get(id);
      if (!robot) continue;
      const doing = this.find(task);
      const late = doing && isAtRisk(doing);
      Object.assign(robot, { battery, task, activity, ownMode: mode, ownReason, queue, loads: loads?.length ?? 0, deadlineAtRisk: late ? task : null });
    }
  }
}
