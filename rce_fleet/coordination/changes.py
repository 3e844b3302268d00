"""Changes of the fleet's state, for publishing.

Poses are not included: they are published for each robot as they arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rce_fleet.coordination.cell_blocks import CellBlock
    from rce_fleet.coordination.snapshot import RobotSnapshot
    from rce_fleet.coordination.zones import Zone


@dataclass(frozen=True, slots=True)
class FleetChanges:
    """A change of the state. Applying it twice is harmless: it has the new state of its robots and cells.

    Attributes:
        sequence: Number of the change, counted from 1.
        robots: Robots that are new or changed, by name.
        removed: Removed robots, ascending.
        blocked: Cells that became blocked, ascending; walls never change.
        pending: Cells that will be blocked once the robots in them have left, ascending.
        freed: Cells that are not blocked or pending any more, ascending.
        zones: Zones that are new or changed, by id.
        removed_zones: Ids of removed zones, ascending.
        blocks: Cells that were blocked by a person or a sensor, or of which who or why changed, ascending.
        removed_blocks: Cells that neither blocks any more, ascending; zones may.
    """

    sequence: int
    robots: tuple[RobotSnapshot, ...] = ()
    removed: tuple[str, ...] = ()
    blocked: tuple[int, ...] = ()
    pending: tuple[int, ...] = ()
    freed: tuple[int, ...] = ()
    zones: tuple[Zone, ...] = ()
    removed_zones: tuple[str, ...] = ()
    blocks: tuple[tuple[int, CellBlock], ...] = ()
    removed_blocks: tuple[int, ...] = ()


class ChangeLog:
    """Collects possible changes, and returns the actual ones.

    Attributes:
        sequence: Number of the last change; 0 before the first.
    """

    def __init__(self) -> None:
        self.sequence = 0
        self._robots: set[str] = set()
        self._cells: set[int] = set()
        self._told: dict[str, RobotSnapshot] = {}
        self._told_cells: dict[int, bool] = {}
        self._told_zones: dict[str, Zone] = {}
        self._told_blocks: dict[int, CellBlock] = {}

    def note_robot(self, robot: str) -> None:
        """Note that a robot may have changed, come or gone."""
        self._robots.add(robot)

    def note_cell(self, cell: int) -> None:
        """Note that a cell may have been blocked or freed, or that who blocked it changed."""
        self._cells.add(cell)

    def take(
        self,
        describe: Callable[[str], RobotSnapshot | None],
        is_blocked: Callable[[int], bool | None],
        zones: Mapping[str, Zone] | None = None,
        block_of: Callable[[int], CellBlock | None] = lambda _cell: None,
    ) -> FleetChanges | None:
        """Return what changed since the last call; None if nothing did.

        Args:
            describe: Returns the state of a robot; None if it was removed.
            is_blocked: Returns whether a cell is blocked (True), pending (False) or neither (None).
            zones: All zones, by id.
            block_of: Returns who blocked a cell, and why; None: neither a person nor a sensor.
        """
        noted, self._robots = sorted(self._robots), set()
        cells, self._cells = sorted(self._cells), set()
        robots = [found for robot in noted if (found := self._tell(robot, describe(robot))) is not None]
        removed = [robot for robot in noted if robot in self._told and describe(robot) is None]
        for robot in removed:
            del self._told[robot]
        parts: dict[bool | None, list[int]] = {True: [], False: [], None: []}
        for cell in cells:
            now = is_blocked(cell)
            if now != self._told_cells.get(cell):
                parts[now].append(cell)
                if now is None:
                    del self._told_cells[cell]
                else:
                    self._told_cells[cell] = now
        blocks, removed_blocks = self._tell_blocks(cells, block_of)
        all_zones = {} if zones is None else zones
        new_zones = tuple(
            all_zones[name] for name in sorted(all_zones) if self._told_zones.get(name) != all_zones[name]
        )
        removed_zones = tuple(sorted(self._told_zones.keys() - all_zones.keys()))
        self._told_zones = dict(all_zones)
        has_news = robots or removed or any(parts.values()) or blocks or removed_blocks
        if not (has_news or new_zones or removed_zones):
            return None
        self.sequence += 1
        return FleetChanges(
            self.sequence,
            tuple(robots),
            tuple(removed),
            blocked=tuple(parts[True]),
            pending=tuple(parts[False]),
            freed=tuple(parts[None]),
            zones=new_zones,
            removed_zones=removed_zones,
            blocks=blocks,
            removed_blocks=removed_blocks,
        )

    def _tell_blocks(
        self, cells: Iterable[int], block_of: Callable[[int], CellBlock | None]
    ) -> tuple[tuple[tuple[int, CellBlock], ...], tuple[int, ...]]:
        """Return the blocks that differ from the last published ones, and the cells that have none now."""
        made: list[tuple[int, CellBlock]] = []
        gone: list[int] = []
        for cell in cells:
            now = block_of(cell)
            if now is None and self._told_blocks.pop(cell, None) is not None:
                gone.append(cell)
            elif now is not None and now != self._told_blocks.get(cell):
                self._told_blocks[cell] = now
                made.append((cell, now))
        return tuple(made), tuple(gone)

    def _tell(self, robot: str, now: RobotSnapshot | None) -> RobotSnapshot | None:
        """Return a robot's state if it differs from the last published one."""
        if now is None:
            return None
        known = replace(now, x=nan, y=nan, yaw=nan)
        if _told(known) == _told(self._told.get(robot)):
            return None
        self._told[robot] = known
        return now


def _told(robot: RobotSnapshot | None) -> tuple[object, ...] | None:
    """Return the published state of a robot, without its pose."""
    if robot is None:
        return None
    return (
        *(robot.state, robot.reason, robot.cell, robot.goal),
        *(robot.plan, robot.granted, robot.replans, robot.mode, robot.pose_only),
    )
