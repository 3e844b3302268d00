"""What the fleet manager keeps beside tasks: robots, places, zones, blocked cells; and its events."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi
from typing import TYPE_CHECKING, TypeAlias

from rce_fleet.tasks.task import Task

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.planning.grid import GridMap

AUTOMATIC = "automatic"
"""The mode in which the planner drives a robot."""
TURNED_BY = ", turned by "
"""Separates size and place of a grid from its direction in :attr:`PlannerRun.floor`."""
OUT_MODES = frozenset({"out_of_service", "dead"})
"""Modes in which a robot takes no goals."""


@dataclass(frozen=True, slots=True)
class RobotProfile:
    """What a robot can do, and what it takes out of its battery.

    The defaults describe a TurtleBot 2 with a payload of 5 kg.

    Attributes:
        capabilities: Names of what it has: ``lift``, ``fork``.
        payload: Most that it carries, kilograms.
        speed: Mean speed, metres per second, turns and waiting included.
        capacity: Energy of the full battery, watt hours.
        drive: Watt hours for each metre.
        idle: Watts of electronics, sensors and computer.
        acting: Watts of an action at a stop, beside ``idle``.
        charging: Watts that a charger gives, ``idle`` included: for when a battery will be full.
        zone_cost: How much more a metre in a zone costs this robot than elsewhere: 2 counts double.
        loaded_zone_cost: The same for its planned ways while it carries a load, in place of ``zone_cost``.
    """

    capabilities: tuple[str, ...] = ()
    payload: float = 5.0
    speed: float = 0.4
    capacity: float = 60.0
    drive: float = 0.012
    idle: float = 8.0
    acting: float = 5.0
    charging: float = 30.0
    zone_cost: dict[str, float] = field(default_factory=dict)
    loaded_zone_cost: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RobotEntry:
    """What people decided about a robot.

    Attributes:
        id: Its name.
        mode: Who drives it, in the planner's words: ``automatic``, ``paused``, ``stopped`` (emergency),
            ``manual``, ``out_of_service`` or ``dead``.
        profile: What it can do; None: the fleet's default.
        reason: Why it has its mode, for people.
        user: Who decided it.
        revision: Grows with each change.
        unsent: A request set the mode, and the planner has not confirmed it yet.
    """

    id: str
    mode: str = AUTOMATIC
    profile: RobotProfile | None = None
    reason: str = ""
    user: str = ""
    revision: int = 1
    unsent: bool = False

    @property
    def is_out(self) -> bool:
        """Whether it was taken out of service: it gets neither goals nor tasks."""
        return self.mode in OUT_MODES


@dataclass(frozen=True, slots=True)
class GoalEntry:
    """Where a person or another program sent a robot.

    Attributes:
        id: The robot's name.
        cell: The goal; None: none, or the robot shall stop (``unsent``).
        user: Who asked for it; empty: a program, at the planner.
        unsent: A request set it, and the planner has not confirmed it yet.
    """

    id: str
    cell: int | None = None
    user: str = ""
    unsent: bool = False


@dataclass(frozen=True, slots=True)
class FleetEntry:
    """What people decided about the fleet as a whole.

    Attributes:
        mode: ``automatic``, ``paused`` or ``stopped`` (emergency).
        reason: Why, for people.
        user: Who decided it.
        revision: Grows with each change.
        unsent: A request changed the mode, and the planner has not confirmed it yet.
    """

    mode: str = AUTOMATIC
    reason: str = ""
    user: str = ""
    revision: int = 0
    unsent: bool = False


@dataclass(frozen=True, slots=True)
class PlannerRun:
    """The planner that the records were last compared with.

    Attributes:
        started: When it began, as its messages have it; empty: none was heard yet.
        floor: Its grid: zones and blocked cells are cells of it.
    """

    started: str = ""
    floor: str = ""

    def has_other_floor(self, before: PlannerRun) -> bool:
        """Return whether its grid is another one than that of a planner before.

        Earlier releases did not know how the grid is turned, and wrote ``0 rad`` for all.
        """
        unturned = f"{self.floor.partition(TURNED_BY)[0]}, 0 rad"
        return before.floor not in ("", self.floor, unturned)


@dataclass(frozen=True, slots=True)
class Places:
    """Cells with a purpose.

    Attributes:
        chargers: Cells with a charger; one robot each.
        parking: Cells where idle robots wait; empty: they stay where they are, unless they are in the way.
        returns: Where loads of cancelled tasks are brought; empty: where they came from.
        revision: Grows with each change.
    """

    chargers: tuple[int, ...] = ()
    parking: tuple[int, ...] = ()
    returns: tuple[int, ...] = ()
    revision: int = 0


@dataclass(frozen=True, slots=True)
class Zone:
    """Cells with a rule.

    Attributes:
        id: Its name.
        kind: What the rule is: ``blocked``, ``slow``, ``one_way``, ``limited`` or ``cost``.
        cells: The cells, ascending.
        value: Number of the rule: speed in metres per second, direction in radians from the grid's columns,
            most robots, or how much a metre counts.
        edges: Moves ``(from, to)`` that a blocked zone does not allow.
        robots: Robots that the rule is for; empty: all.
        reason: Why, for people.
        user: Who made it.
        until: When it ends, seconds since 1970; None: when it is removed.
        revision: Grows with each change.
        is_removed: Whether it was removed.
        unsent: A request made, changed or removed it, and the planner has not confirmed it yet.
    """

    id: str
    kind: str
    cells: tuple[int, ...]
    value: float | None = None
    edges: tuple[tuple[int, int], ...] = ()
    robots: tuple[str, ...] = ()
    reason: str = ""
    user: str = ""
    until: float | None = None
    revision: int = 1
    is_removed: bool = False
    unsent: bool = False

    def applies_to(self, robot: str) -> bool:
        """Return whether the rule is for this robot."""
        return not self.robots or robot in self.robots

    @property
    def closes_moves(self) -> bool:
        """Whether it closes moves between cells that robots may be in."""
        return self.kind == "one_way" or bool(self.edges)

    def closed(self, grid: GridMap) -> frozenset[tuple[int, int]]:
        """Return the moves ``(from, to)`` between cells beside each other that it does not allow."""
        moves = grid.adjacent_moves(self.edges)
        if self.kind == "one_way":
            against = (-1, -grid.columns, 1, grid.columns)[round((self.value or 0.0) / (pi / 2)) % 4]
            moves |= grid.moves_by(against, self.cells)
        return moves


@dataclass(frozen=True, slots=True)
class CellBlock:
    """Who blocked a cell, why, since when and until when.

    Attributes:
        user: Who blocked it; empty: a robot's sensor, or not told.
        reason: Why, for people.
        since: When it was blocked, seconds since 1970; None: not told.
        until: When it is freed, seconds since 1970; None: it stays blocked.
        robot: The robot whose sensor found it blocked; empty: people blocked it.
    """

    user: str = ""
    reason: str = ""
    since: float | None = None
    until: float | None = None
    robot: str = ""

    def has_ended(self, now: float) -> bool:
        """Return whether its time has come, at ``now`` in seconds since 1970."""
        return self.until is not None and self.until <= now


NOT_KNOWN = CellBlock()
"""Of a cell of which is not known who blocked it: journals of earlier releases do not tell."""


@dataclass(frozen=True, slots=True)
class BlockedCells:
    """Cells that people blocked, to send them again to a planner that was restarted.

    Attributes:
        cells: The cells, ascending.
        unsent: Cells that requests blocked or freed, and the planner has not confirmed yet; ascending.
        blocks: Who blocked which of the cells, and why; journals of earlier releases have none.
    """

    cells: tuple[int, ...] = ()
    unsent: tuple[int, ...] = ()
    blocks: dict[int, CellBlock] = field(default_factory=dict)

    def block(self, cell: int) -> CellBlock:
        """Return who blocked one of the cells, and why, as far as that is known."""
        return self.blocks.get(cell, NOT_KNOWN)

    def changed(
        self, changes: Mapping[int, bool], *, unsent: bool, blocks: Mapping[int, CellBlock] | None = None
    ) -> BlockedCells:
        """Return the cells after some were blocked (True) or freed.

        Args:
            changes: The cells.
            unsent: Whether the planner has to be told.
            blocks: Who blocked them, and why, as far as that is known.
        """
        kept = {*self.cells} - {*changes}
        waiting = {*self.unsent} - {*changes}
        kept |= {cell for cell, blocked in changes.items() if blocked}
        told = {cell: block for cell, block in self.blocks.items() if cell not in changes}
        told |= {cell: block for cell, block in (blocks or {}).items() if cell in changes}
        return BlockedCells(
            tuple(sorted(kept)),
            tuple(sorted(waiting | {*changes} if unsent else waiting)),
            {cell: told[cell] for cell in sorted(told.keys() & kept)},
        )


Record: TypeAlias = Task | RobotEntry | GoalEntry | FleetEntry | PlannerRun | Places | Zone | BlockedCells
RECORD_TYPES: dict[str, type[Record]] = {
    "task": Task,
    "robot": RobotEntry,
    "goal": GoalEntry,
    "fleet": FleetEntry,
    "planner": PlannerRun,
    "places": Places,
    "zone": Zone,
    "cells": BlockedCells,
}
"""The kinds of records, as events and the journal name them."""
_KINDS = {record_type: kind for kind, record_type in RECORD_TYPES.items()}


def key_of(record: Record) -> tuple[str, str]:
    """Return a record's kind, and which one of its kind it is; empty: there is only one."""
    return _KINDS[type(record)], str(getattr(record, "id", ""))


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """Something that happened, with the whole new record of what it happened to.

    Attributes:
        number: Counts the events from 1, without a gap.
        time: When, seconds since 1970.
        kind: What it happened to: ``task``, ``robot``, ``goal``, ``fleet``, ``planner``, ``places``,
            ``zone`` or ``cells``.
        id: Which one: ``T12``, ``Robot1``; empty: there is only one.
        name: What happened: ``created``, ``arrived``.
        user: Who did it; empty: the manager.
        text: The same for people.
        record: What it is now.
    """

    number: int
    time: float
    kind: str
    id: str
    name: str
    user: str
    text: str
    record: Record
