// What is in a cell, in words: for people who move the cursor by keys and do not see the map.

import { t } from "./texts.js";

// The time of day; with the date if it is another day.
function timeText(seconds) {
  const at = new Date(1000 * seconds);
  const time = at.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
  return at.toDateString() === new Date().toDateString() ? time : t("cell.dated", { date: at.toLocaleDateString(), time });
}

// block: who blocked the cell, and why; undefined: a zone did, or the planner does not tell.
function blockText(block) {
  if (!block) return t("cell.blocked");
  const { user, robot, reason, since, until } = block;
  if (robot) return t("cell.sensed", { robot, time: timeText(since) });
  const who = user ? t("cell.blockedBy", { user }) : t("cell.blocked");
  const when = until ? t("cell.until", { time: timeText(until) }) : t("cell.since", { time: timeText(since) });
  return `${reason ? `${who}: ${reason}` : who}, ${when}`;
}

function zoneText({ id, kind, reason, user, until }) {
  const text = t("cell.zone", { zone: id });
  const details = [reason, user && t("cell.by", { user }), until && t("cell.until", { time: timeText(until) })].filter(Boolean);
  return kind === "blocked" && details.length ? `${text} (${details.join(", ")})` : text;
}

// zones: those of the fleet manager.
export function describeCell(fleet, zones, cell) {
  const { columns } = fleet.map;
  const parts = [t("cell.place", { cell, row: Math.floor(cell / columns), column: cell % columns })];
  const block = fleet.blocks.get(cell);
  if (fleet.walls.has(cell)) parts.push(t("cell.wall"));
  else if (fleet.blocked.has(cell)) parts.push(blockText(block));
  else if (fleet.pending.has(cell)) parts.push(t("cell.pending"), ...(block ? [blockText(block)] : []));
  for (const { id, state, cell: at, goal } of fleet.robots.values()) {
    if (at === cell) parts.push(t("cell.robot", { robot: id, state }));
    if (goal === cell && at !== cell) parts.push(t("cell.goal", { robot: id }));
  }
  for (const zone of zones) if (zone.cells.includes(cell)) parts.push(zoneText(zone));
  for (const { name, cells, one_way } of fleet.map.lanes ?? []) if (cells.includes(cell)) parts.push(t(one_way ? "cell.oneWay" : "cell.lane", { lane: name }));
  return parts.length > 1 ? parts.join(", ") : `${parts[0]}, ${t("cell.free")}`;
}
