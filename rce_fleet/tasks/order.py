"""What a task asks for: stops with actions, and the conditions under which they are carried out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite
from typing import TYPE_CHECKING

from rce_fleet.exceptions import TaskRefusedError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.planning.grid import GridMap

MOST_STOPS = 500
"""Stops of a task, all rounds counted."""
MOST_CELLS = 100
"""Cells that one stop may name."""
MOST_SECONDS = 7 * 86400.0
"""Longest duration of an action."""
MOST_BETWEEN = 366 * 86400.0
"""Most seconds between two occurrences of a task."""


class Action(Enum):
    """What a robot does at a stop."""

    GO = "go"
    """It only goes there, and stays for the duration."""
    PICK = "pick"
    """It takes a load."""
    DELIVER = "deliver"
    """It gives a load away."""
    CHARGE = "charge"
    """It charges until its battery is full, or for the duration; without cells, at any charger."""
    PARK = "park"
    """It goes out of the way; without cells, to any parking place."""


class WhenLate(Enum):
    """What happens to a task at its deadline."""

    CONTINUE = "continue"
    """It is carried out later; an event says that it is late."""
    FAIL = "fail"
    """It fails, unless a robot has begun with it."""


@dataclass(frozen=True, slots=True)
class Stop:
    """One stop of a task.

    Attributes:
        action: What the robot does there.
        cells: Where: any one of these cells. Empty only for :attr:`Action.CHARGE` and :attr:`Action.PARK`.
        duration: How long the action takes, seconds.
        confirm: The action ends when a person or program confirms it, and not before the duration.
        label: What the action is, for people.
    """

    action: Action
    cells: tuple[int, ...] = ()
    duration: float = 0.0
    confirm: bool = False
    label: str = ""

    @property
    def moves_load(self) -> bool:
        """Whether a load is taken or given away."""
        return self.action in (Action.PICK, Action.DELIVER)


@dataclass(frozen=True, slots=True)
class Order:
    """What the requester of a task asks for. Times are seconds since 1970.

    Attributes:
        stops: In order.
        rounds: How often the stops are made: a patrol has several.
        name: For people.
        priority: Tasks with a larger number come first.
        deadline: When the task should be done; None: at any time.
        when_late: What happens at the deadline.
        earliest_start: No robot begins before; None: at once.
        capabilities: What the robot must have.
        payload: What the robot must carry, kilograms.
        after: Tasks that must be done before, by id.
        robot: The only robot that may do it; empty: any.
        return_cells: Where a load is brought when the task is cancelled; empty: the fleet's return cells, or
            where the load came from.
        every: Seconds from one occurrence to the next; None: it does not recur.
        occurrences: How many there are in all; None: until it is cancelled.
    """

    stops: tuple[Stop, ...]
    rounds: int = 1
    name: str = ""
    priority: int = 0
    deadline: float | None = None
    when_late: WhenLate = WhenLate.CONTINUE
    earliest_start: float | None = None
    capabilities: tuple[str, ...] = ()
    payload: float = 0.0
    after: tuple[str, ...] = ()
    robot: str = ""
    return_cells: tuple[int, ...] = ()
    every: float | None = None
    occurrences: int | None = None

    @property
    def length(self) -> int:
        """Number of stops, all rounds counted."""
        return len(self.stops) * self.rounds

    def stop(self, number: int) -> Stop:
        """Return a stop, counted from 0 over all rounds."""
        return self.stops[number % len(self.stops)]

    def cells(self, made: int = 0) -> Iterator[int]:
        """Return the cells that the order names.

        Args:
            made: Number of stops, all rounds counted, that do not come again.
        """
        left = self.length - made
        for stop in self.stops[max(0, len(self.stops) - left) :]:
            yield from stop.cells
        yield from self.return_cells


def check_order(order: Order) -> None:
    """Check what an order says about itself.

    Raises:
        TaskRefusedError: It cannot be carried out; the text says why.
    """
    for problem in _problems(order):
        raise TaskRefusedError(problem)


def _problems(order: Order) -> Iterator[str]:
    if not order.stops:
        yield "a task needs at least one stop"
    if order.rounds < 1:
        yield f"rounds must be at least 1, not {order.rounds}"
    if order.length > MOST_STOPS:
        yield f"a task has at most {MOST_STOPS} stops with all its rounds, not {order.length}"
    yield from _problems_of_stops(order)
    if not (isfinite(order.payload) and order.payload >= 0):
        yield f"payload must be a number of kilograms from 0, not {order.payload}"
    start = -inf if order.earliest_start is None else order.earliest_start
    if order.deadline is not None and order.deadline <= start:
        yield "the deadline must be after the earliest start"
    if order.every is not None and not 1 <= order.every <= MOST_BETWEEN:
        yield f"a task recurs every 1 .. {MOST_BETWEEN:g} s, not every {order.every:g} s"
    if order.occurrences is not None and (order.every is None or order.occurrences < 1):
        yield "occurrences needs a recurring task (every), and must be at least 1"


def _problems_of_stops(order: Order) -> Iterator[str]:
    loads = 0
    for number, stop in enumerate(order.stops, 1):
        place = f"stop {number} ({stop.action.value})"
        if not stop.cells and stop.action not in (Action.CHARGE, Action.PARK):
            yield f"{place} needs a cell"
        if len(stop.cells) > MOST_CELLS:
            yield f"{place} names {len(stop.cells)} cells; at most {MOST_CELLS} are possible"
        if not 0 <= stop.duration <= MOST_SECONDS:
            yield f"the duration of {place} must be within 0 .. {MOST_SECONDS:g} s, not {stop.duration}"
        loads += (stop.action is Action.PICK) - (stop.action is Action.DELIVER)
        if loads < 0:
            yield f"{place} has no load to deliver: a pick must come before it"
    if loads > 0 and order.rounds > 1:
        yield "a task with rounds must deliver in each round what it picks"


def check_cells(order: Order, grid: GridMap, made: int = 0) -> None:
    """Check that the cells of an order are on the map, and not in its walls.

    Args:
        order: The order.
        grid: The map.
        made: Number of stops that were made, maybe on another map.

    Raises:
        TaskRefusedError: A cell cannot be entered.
    """
    for cell in order.cells(made):
        if cell not in grid:
            raise TaskRefusedError(
                f"cell {cell} is not on the map of {len(grid)} cells (0 .. {len(grid) - 1})"
            )
        if cell in grid.blocked:
            raise TaskRefusedError(f"cell {cell} is a wall; choose a free cell")
