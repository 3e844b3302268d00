// The table of robots, those in trouble first. Only the rows on the screen exist, so that a thousand robots cost little.

import { colourOf } from "./colours.js";
import { TROUBLE, heartbeatAge } from "./conditions.js";
import { element } from "./engine.js";
import { isPressed } from "./rows.js";
import { t } from "./texts.js";

const DRAW_EVERY_MS = 250;
const ROW_PX = 31;
const SPARE_ROWS = 6; // above and below the visible ones
// Move clients report twice a second, and the planner tells it every two seconds.
const FRESH_S = 3;
const LATE_S = 5;

export class RobotsTable {
  #order = [];        // ids as they are shown
  #names = [];        // ids by name; sorted again only when robots come or go
  #orderAt = 0;
  #rows = [];         // the rows on the screen, which show other robots when the table is scrolled
  #above = spacer();
  #below = spacer();

  // show: (robot) => selects it and moves the map there
  constructor(fleet, show) {
    this.fleet = fleet;
    this.box = document.querySelector("#robots-box");
    this.body = document.querySelector("#robots tbody");
    this.find = document.querySelector("#robots-find");
    this.summary = document.querySelector("#summary");
    for (const type of ["state", "selected"]) fleet.addEventListener(type, () => this.draw());
    fleet.addEventListener("changes", () => this.#drawSoon());
    this.box.addEventListener("scroll", () => this.#drawRows());
    this.find.addEventListener("input", () => this.draw());
    this.body.addEventListener("click", (event) => {
      const row = event.target.closest("tr[data-robot]");
      if (row) fleet.select(row.dataset.robot);
    });
    this.body.addEventListener("dblclick", (event) => {
      const row = event.target.closest("tr[data-robot]");
      if (row) show(row.dataset.robot);
    });
    this.body.addEventListener("keydown", (event) => {
      const row = event.target.closest("tr[data-robot]");
      if (!row || (event.key !== "Enter" && event.key !== " ")) return;
      event.preventDefault();
      if (event.key === "Enter") show(row.dataset.robot);
      else fleet.select(row.dataset.robot);
    });
    setInterval(() => this.draw(), 1000);
  }

  // Changes come up to ten times a second; the table is drawn less often.
  #drawSoon() {
    this.drawing ??= setTimeout(() => this.draw(), DRAW_EVERY_MS);
  }

  draw() {
    clearTimeout(this.drawing);
    this.drawing = null;
    const wanted = this.find.value.trim().toLowerCase();
    const { robots } = this.fleet;
    const now = performance.now();
    if (robots.size !== this.#names.length || !this.#names.every((id) => robots.has(id))) {
      this.#names = [...robots.keys()].sort(collator.compare);
      this.#orderAt = -Infinity;
    }
    if (now - this.#orderAt > 900 || wanted !== this.wanted) {
      this.#orderAt = now;
      this.wanted = wanted;
      const [worst, trouble, others] = [[], [], []];
      for (const id of this.#names) {
        const robot = robots.get(id);
        if (wanted && !`${id} ${robot.state}`.toLowerCase().includes(wanted)) continue;
        if (robot.undelivered) worst.push(id);
        else (TROUBLE.has(robot.state) || robot.emergency ? trouble : others).push(id);
      }
      this.#order = [...worst, ...trouble, ...others];
    }
    let busy = 0;
    for (const robot of robots.values()) if (robot.plan.length > 1) busy++;
    setText(this.summary, robots.size ? t("robots.summary", { count: robots.size, busy }) : t("robots.none"));
    this.#drawRows();
  }

  #drawRows() {
    if (isPressed(this.body)) return;
    const first = Math.max(0, Math.floor(this.box.scrollTop / ROW_PX) - SPARE_ROWS);
    const count = Math.ceil((this.box.clientHeight || 400) / ROW_PX) + 2 * SPARE_ROWS;
    const ids = this.#order.slice(first, first + count).filter((id) => this.fleet.robots.has(id));
    const focused = document.activeElement?.closest?.("#robots tr")?.dataset.robot;
    while (this.#rows.length < ids.length) this.#rows.push(new Row());
    ids.forEach((id, index) => this.#rows[index].show(this.fleet.robots.get(id), id === this.fleet.selected));
    const rows = this.#rows.slice(0, ids.length).map(({ row }) => row);
    const below = this.#order.length - first - ids.length;
    const wanted = [...(first ? [this.#above] : []), ...rows, ...(below > 0 ? [this.#below] : [])];
    const { children } = this.body;
    if (children.length !== wanted.length || wanted.some((row, index) => row !== children[index])) this.body.replaceChildren(...wanted);
    setHeight(this.#above, first);
    setHeight(this.#below, below);
    if (focused) {
      const row = this.body.querySelector(`tr[data-robot="${CSS.escape(focused)}"]`);
      if (row !== document.activeElement) row?.focus();
    }
  }
}

// A row of the table; only what differs from before is written, so that the page is laid out rarely.
class Row {
  constructor() {
    this.row = element("tr");
    this.row.tabIndex = 0;
    this.dot = element("span", "", "dot");
    this.name = document.createTextNode("");
    this.cells = Array.from({ length: 6 }, () => element("td"));
    this.cells[0].append(this.dot, this.name);
    this.row.append(...this.cells);
  }

  show(robot, selected) {
    const { row, cells } = this;
    if (row.dataset.robot !== robot.id) {
      row.dataset.robot = robot.id;
      this.name.data = robot.id;
      this.dot.style.background = colourOf(robot.id);
    }
    if (row.title !== robot.reason) row.title = robot.reason;
    if (row.ariaSelected !== String(selected)) row.setAttribute("aria-selected", selected);
    const age = heartbeatAge(robot);
    const [, state, cell, goal, replans, seen] = cells;
    if (state.title !== (robot.pose_only ? t("robot.poseOnly") : "")) state.title = robot.pose_only ? t("robot.poseOnly") : "";
    setText(state, stateText(robot), robot.emergency || TROUBLE.has(robot.state) ? "bad" : "");
    setText(cell, robot.cell ?? "");
    setText(goal, robot.goal ?? "");
    setText(replans, robot.replans);
    setText(seen, age === null ? t("age.never") : age < FRESH_S ? t("age.now") : t("age.seconds", { seconds: Math.round(age) }), age === null || age >= LATE_S ? "warn" : "quiet");
  }
}

// A robot that has not got its stop may be driving: its own state stays visible.
function stateText({ emergency, undelivered, state, pose_only: isByPose }) {
  if (undelivered) return t("state.undelivered", { state });
  if (emergency) return t("state.emergency");
  return isByPose ? t("state.poseOnly", { state }) : state;
}

function setText(part, text, name = "") {
  if (part.textContent !== String(text)) part.textContent = text;
  if (part.className !== name) part.className = name;
}

const collator = new Intl.Collator("en", { numeric: true });

function spacer() {
  const row = element("tr");
  const cell = element("td");
  cell.colSpan = 6;
  cell.style.padding = "0";
  row.setAttribute("aria-hidden", "true");
  row.append(cell);
  return row;
}

function setHeight(spacing, rows) {
  const height = `${rows * ROW_PX}px`;
  if (spacing.firstChild.style.height !== height) spacing.firstChild.style.height = height;
}
