// The list of tasks with their expected ends, and the form for a new one.

import { clock, isAtRisk } from "./conditions.js";
import { element } from "./engine.js";
import { isPressed, placeRows } from "./rows.js";
import { t } from "./texts.js";
import { ENDED } from "./work.js";

const TONE = { running: "good", queued: "quiet", assigned: "quiet", held: "warn", suspended: "warn", cancelling: "warn", failed: "bad", cancelled: "quiet", done: "good" };

const MOST_OPEN = 100;

// Whether the action that is under way ends only when a person or a program confirms it.
function awaitsConfirmation({ visits, stops }) {
  const last = visits.at(-1);
  return last?.ended_at === null && last.stop >= 0 && stops[last.stop % stops.length].confirm;
}

export class TasksPanel {
  steers = true;

  constructor(work, actions, fleet) {
    this.work = work;
    this.actions = actions;
    this.fleet = fleet;
    this.body = document.querySelector("#tasks tbody");
    this.note = document.querySelector("#tasks-note");
    work.addEventListener("change", () => this.draw());
  }

  draw() {
    if (isPressed(this.body)) return;
    const { work } = this;
    const open = [...work.tasks.values()].slice(0, MOST_OPEN);
    const tasks = [...open, ...work.recurring, ...work.recent.slice(0, 5)];
    const more = work.openCount - open.length;
    this.note.textContent = work.trouble === "none" ? t("tasks.noManager") : work.trouble ?? (tasks.length ? "" : t("tasks.none"));
    const focused = document.activeElement?.id;
    const rows = tasks.flatMap((task) => [this.#row(task), this.#buttons(task)]);
    if (more > 0) rows.splice(2 * open.length, 0, this.#more(more));
    const before = new Map([...this.body.children].map((row) => [row.dataset.key, row]));
    placeRows(this.body, rows.map((row) => (before.get(row.dataset.key)?.isEqualNode(row) ? before.get(row.dataset.key) : row)));
    if (focused?.startsWith("task-")) document.getElementById(focused)?.focus();
  }

  // Open tasks that are not listed.
  #more(count) {
    const row = element("tr");
    row.dataset.key = "more";
    const cell = element("td", t("tasks.more", { count }), "quiet");
    cell.colSpan = 5;
    row.append(cell);
    return row;
  }

  #row(task) {
    const row = element("tr");
    row.dataset.task = task.id;
    row.dataset.key = task.id;
    row.title = task.reason;
    const stops = task.stops.map(({ action, cell, cells }) => `${t(`stop.${action}`)} ${cell ?? cells?.join("/") ?? ""}`.trim()).join(", ");
    const state = element("td", t(`task.${task.state}`), TONE[task.state]);
    row.append(element("td", task.id), element("td", task.name || stops), state, element("td", task.robot_assigned || ""), this.#end(task));
    return row;
  }

  // When it ends, ended, or recurs; a deadline that is at risk has a sign and a colour.
  #end(task) {
    const ended = ENDED.includes(task.state);
    if (ended && task.recurs_at) return element("td", t("tasks.next", { time: clock(task.recurs_at) }), "quiet");
    const at = ended ? task.changed_at : task.expected_end;
    const risk = !ended && isAtRisk(task);
    const text = at ? clock(at) : !ended && task.earliest_end ? t("tasks.earliest", { time: clock(task.earliest_end) }) : "";
    return element("td", risk ? `\u26a0 ${text}` : text, risk ? "bad" : "quiet");
  }

  // A row below the task's.
  #buttons(task) {
    const row = element("tr");
    row.dataset.key = `answers ${task.id}`;
    const cell = element("td", "", "answers");
    cell.colSpan = 5;
    row.append(cell);
    const recurs = ENDED.includes(task.state) && task.recurs_at;
    if (!this.steers || task.state === "cancelling" || (ENDED.includes(task.state) && !recurs)) return row;
    const add = (name, run) => {
      const button = element("button", t(`action.${name}`));
      button.type = "button";
      button.id = `task-${task.id}-${name}`;
      button.setAttribute("aria-label", `${t(`action.${name}`)}: ${task.id}`);
      button.addEventListener("click", async () => { await run(); this.work.refresh(); });
      cell.append(button);
    };
    if (awaitsConfirmation(task)) add("confirm", () => this.actions.confirmTask(task.id));
    if (task.state === "held") add("resume", () => this.actions.resumeTask(task.id));
    else if (!recurs) add("hold", () => this.actions.holdTask(task.id));
    add("raise", () => this.actions.raise(task.id, Math.min(100, ((this.work.tasks.get(task.id) ?? task).priority ?? 0) + 10)));
    add("cancel", () => this.actions.cancelTask(task.id));
    return row;
  }
}
