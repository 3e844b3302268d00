// What needs the operator: which robots are in trouble, and how badly. Independent of the screen.

import { t } from "./texts.js";

export const LOW_BATTERY = 0.2;
export const OFFLINE_S = 5;
const STUCK_S = 60;

// Marks on the map; each has a shape of its own.
export const MARK = { none: 0, trouble: 1, offline: 2, manual: 3, stopped: 4, lost: 5 };

export const TROUBLE = new Set(["unreachable", "silent", "lost", "dead"]);

// Answers that the fleet manager gives; without one they are not offered.
const NEEDS_MANAGER = new Set(["pause", "resume", "takeOut", "putIn", "charge", "reassign", "raise"]);

export function isPossible(answer, fleet, id) {
  if (answer === "localize" && isLight(fleet, id)) return false;
  return fleet.manager || !NEEDS_MANAGER.has(answer);
}

// Whether it is a light robot of the simulated world: it always knows where it is, and cannot be told.
export const isLight = (fleet, id) => fleet.things[id]?.[0] === "light";

const OUT_MODES = new Set(["out_of_service", "dead"]);

// The planner hears these: one that gives it no sign of life for a few seconds is "silent".
const HEARD = new Set(["driving", "waiting", "arrived", "idle", "unreachable", "lost"]);

// Seconds since the last sign of life; null if there was none. The planner tells it with the poses, every two seconds
// at least. Of one that does not, only the time of the last pose is known, which a robot that stands does not send.
export function heartbeatAge(robot, now = performance.now()) {
  if (robot.heard !== null && robot.heard !== undefined) return Math.max(0, (now - robot.heard) / 1000);
  if (HEARD.has(robot.state)) return 0;
  return robot.seen === null || robot.seen === undefined ? null : (now - robot.seen) / 1000;
}

export function markOf(robot) {
  if (robot.emergency && !robot.undelivered) return MARK.stopped;
  if (robot.state === "silent" || robot.state === "offline") return MARK.offline;
  if (robot.undelivered) return MARK.trouble;
  if (robot.mode === "manual" || robot.driver) return MARK.manual;
  if (robot.state === "lost") return MARK.lost;
  return TROUBLE.has(robot.state) ? MARK.trouble : MARK.none;
}

// Whether people have taken a robot from the fleet, until they put it in: it may be switched off, and waits for nothing.
export const isOut = ({ mode, ownMode, activity }) => activity === "out" || OUT_MODES.has(mode) || OUT_MODES.has(ownMode);

// All that is wrong with a robot, worst first: {kind, severity (4 is worst), text}.
export function conditionsOf(robot, now = performance.now()) {
  const found = [];
  const add = (kind, severity, text) => found.push({ kind, severity, text });
  const age = heartbeatAge(robot, now);
  if (robot.undelivered) add("undelivered", 4, t("condition.undelivered", { user: robot.emergency }));
  else if (robot.emergency) add("emergency", 3, t("condition.emergency", { user: robot.emergency }));
  if (isOut(robot)) return found;
  if (robot.state === "silent") add("offline", 3, [robot.reason || t("condition.silent"), age !== null && t("condition.offline", { seconds: Math.round(age) })].filter(Boolean).join("; "));
  else if (age !== null && age > OFFLINE_S && robot.state !== "joining" && !HEARD.has(robot.state)) add("offline", 2, t("condition.offline", { seconds: Math.round(age) }));
  if (robot.state === "unreachable") add("stuck", 3, robot.reason || t("condition.unreachable", { cell: robot.goal ?? "?" }));
  if (robot.waitingSince !== null && robot.waitingSince !== undefined) {
    const waited = (now - robot.waitingSince) / 1000;
    if (waited > STUCK_S) add("stuck", 2, t("condition.waiting", { seconds: Math.round(waited) }));
  }
  if (robot.state === "lost") add("lost", 3, robot.reason || t("condition.lost"));
  if (Number.isFinite(robot.battery) && robot.battery < LOW_BATTERY) {
    add("battery", robot.battery < LOW_BATTERY / 2 ? 3 : 2, t("condition.battery", { percent: Math.round(100 * robot.battery) }));
  }
  if (robot.deadlineAtRisk) add("deadline", 2, t("condition.deadline", { task: robot.deadlineAtRisk }));
  return found.sort((a, b) => b.severity - a.severity);
}

// All that is wrong with tasks that no robot does, or whose load is on a robot that does not come back:
// {task, conditions}, as with a robot.
export function taskConditionsOf({ questions, atRisk }) {
  const one = (task, kind, severity, text) => ({ task, conditions: [{ kind, severity, text }] });
  return [
    ...questions.map((task) => one(task, "load", 3, task.question)),
    ...atRisk.map((task) => one(task, "lateTask", 2, t(task.late ? "condition.lateTask" : "condition.taskAtRisk", { time: clock(task.deadline) }))),
  ];
}

// Time of day.
export function clock(seconds) {
  return new Date(1000 * seconds).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hour12: false });
}

// Whether a task that has not ended will probably miss its deadline.
export function isAtRisk({ deadline, late, expected_end: expected, earliest_end: earliest }, now = Date.now() / 1000) {
  return Boolean(deadline) && (late || (expected ?? earliest ?? now) > deadline);
}

// The cells where the load of a task may be: where its robot is, and where it was taken. A task with rounds may have several loads.
export function loadCells({ visits, stops, rounds, robot_assigned: id }, robots) {
  if (rounds > 1) return [];
  const picked = visits.filter(({ stop }) => stop >= 0 && stops[stop].action === "pick").at(-1)?.cell ?? null;
  const here = robots.get(id)?.cell ?? null;
  const cells = [[here, "withRobot"], [picked, "taken"]].filter(([cell]) => cell !== null);
  return here === picked ? cells.slice(0, 1) : cells;
}

// All that is wrong with the whole fleet: as with a robot.
export function fleetConditionsOf({ plannerAwaySince }) {
  if (plannerAwaySince === null) return [];
  return [{ kind: "planner", severity: 4, text: t("condition.planner", { time: new Date(1000 * plannerAwaySince).toLocaleTimeString() }) }];
}

// From so many robots on, those that one stop of the whole fleet concerns, and nothing else, are one row.
const GROUP_FROM = 5;
const GROUPED = ["undelivered", "emergency"];

// Rows of exceptions: {robots, conditions}. After STOP ALL a row for each robot would hide everything else.
export function rowsOf(exceptions, isFleetStopped) {
  const alike = new Map();
  const rows = exceptions.map(({ robot, conditions }) => {
    const [{ kind, text }] = conditions;
    if (!isFleetStopped || conditions.length > 1 || !GROUPED.includes(kind)) return { robots: [robot], conditions };
    const key = JSON.stringify([kind, text]);
    if (!alike.has(key)) alike.set(key, { robots: [], conditions });
    alike.get(key).robots.push(robot);
    return alike.get(key);
  });
  return [...new Set(rows)].flatMap((row) => (row.robots.length < GROUP_FROM ? row.robots.map((robot) => ({ robots: [robot], conditions: row.conditions })) : [row]));
}

// The fleet's exceptions: {robot, conditions}, worst first.
export function exceptionsOf(robots, now = performance.now()) {
  const found = [];
  for (const robot of robots) {
    const conditions = conditionsOf(robot, now);
    if (conditions.length) found.push({ robot, conditions });
  }
  return found.sort((a, b) => b.conditions[0].severity - a.conditions[0].severity || a.robot.id.localeCompare(b.robot.id, "en", { numeric: true }));
}
