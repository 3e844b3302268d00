// What is in a cell, in words: for people who move the cursor by keys and do not see the map.

import { t } from "./texts.js";

// zones: those of the fleet manager.
export function describeCell(fleet, zones, cell) {
  const { columns } = fleet.map;
  const parts = [t("cell.place", { cell, row: Math.floor(cell / columns), column: cell % columns })];
  if (fleet.walls.has(cell)) parts.push(t("cell.wall"));
  else if (fleet.blocked.has(cell)) parts.push(t("cell.blocked"));
  else if (fleet.pending.has(cell)) parts.push(t("cell.pending"));
  for (const { id, state, cell: at, goal } of fleet.robots.values()) {
    if (at === cell) parts.push(t("cell.robot", { robot: id, state }));
    if (goal === cell && at !== cell) parts.push(t("cell.goal", { robot: id }));
  }
  for (const { id, cells } of zones) if (cells.includes(cell)) parts.push(t("cell.zone", { zone: id }));
  for (const { name, cells, one_way } of fleet.map.lanes ?? []) if (cells.includes(cell)) parts.push(t(one_way ? "cell.oneWay" : "cell.lane", { lane: name }));
  return parts.length > 1 ? parts.join(", ") : `${parts[0]}, ${t("cell.free")}`;
}
