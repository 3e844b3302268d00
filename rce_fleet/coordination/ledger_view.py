"""What the ledger records, read and checked; :mod:`rce_fleet.coordination.ledger` changes it."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from itertools import count, pairwise
from math import inf
from typing import TYPE_CHECKING, Literal, TypeAlias

from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections import deque

QueuedVisit: TypeAlias = tuple[float, str, int]
"""Its step, the robot, and its number among the robot's visits. Tuples, so that a queue is searched fast."""
AFTER_ALL = "\U0010ffff"
"""In place of a robot: behind all visits of the same step."""
CELLS: Literal["i"] = "i"
"""Type of an array of cells: parts of it are copied as bytes, for plans."""
STEPS: Literal["d"] = "d"
"""Type of an array of steps."""


@dataclass(slots=True)
class Account:
    """One robot's part of the ledger.

    Attributes:
        route: The cell that it is in, then those it will enter. Empty for a robot without a cell.
        steps: The step of each visit of the route, growing.
        granted: How many cells of the route it may use; the first always.
        extra: Further cells that it overlaps.
        passed: Number of cells that it has left so far; numbers its visits.
        owned: The cells whose owner it is.
        version: Changes whenever the route changes otherwise than by a plan, or by the robot's progress.
    """

    route: array[int] = field(default_factory=lambda: array(CELLS))
    steps: array[float] = field(default_factory=lambda: array(STEPS))
    granted: int = 0
    extra: frozenset[int] = frozenset()
    passed: int = 0
    owned: set[int] = field(default_factory=set)
    version: int = 0

    @property
    def claims(self) -> set[int]:
        """The cells that it may use or overlaps."""
        return {*self.route[: self.granted], *self.extra}

    def visit(self, robot: str, index: int) -> QueuedVisit:
        """Return the visit of cell number ``index`` of the route, as it is in the cell's queue."""
        return self.steps[index], robot, self.passed + index

    def clear(self) -> None:
        """Have no cells any more."""
        self.route, self.steps, self.granted, self.extra = array(CELLS), array(STEPS), 0, frozenset()


class LedgerView:
    """The record of claims and turns, for reading.

    Invariants, checked by :meth:`validate`:

    - the claims of two robots are disjoint;
    - a robot's granted cells are different from each other;
    - a cell's queue begins with the visit of the robot that was granted it;
    - queues hold the visits of all routes, and nothing else;
    - in an ordered ledger, steps grow along routes and queues.

    Attributes:
        ordered: Whether cells are granted in the order of steps; may be changed before :meth:`begin_plan`.
        clock: The step that the fleet has reached, about: the greatest one of all arrivals.
    """

    def __init__(self) -> None:
        self.ordered = True
        self.clock = 0.0
        self._last_step = 0.0
        self._accounts: dict[str, Account] = {}
        self._owners: dict[int, str] = {}
        self._queues: dict[int, deque[QueuedVisit]] = {}
        self._changed: set[str] = set()
        self._freed: set[int] = set()
        self._ripe: set[str] = set()
        self._versions = count(1)

    def account(self, robot: str) -> Account:
        """Return the record of a robot that has a cell; not to be changed."""
        return self._accounts[robot]

    def claims(self, robot: str) -> frozenset[int]:
        """Return the cells that the robot claims."""
        account = self._accounts.get(robot)
        return frozenset(account.claims) if account else frozenset()

    def owner(self, cell: int) -> str | None:
        """Return the robot that claims a cell."""
        return self._owners.get(cell)

    def route(self, robot: str) -> list[int]:
        """Return the robot's cell and all cells that it will enter."""
        account = self._accounts.get(robot)
        return list(account.route) if account else []

    def granted(self, robot: str) -> list[int]:
        """Return the robot's cell and the cells that it may enter now."""
        account = self._accounts.get(robot)
        return account.route[: account.granted].tolist() if account else []

    def visitors(self, cell: int) -> set[str]:
        """Return the robots whose routes lead through a cell or begin there."""
        return {robot for _, robot, _ in self._queues.get(cell, ())}

    def horizon(self, robot: str) -> list[tuple[int, float]]:
        """Return the last granted cell and those after it, each with its step."""
        account = self._accounts.get(robot)
        if account is None or not account.granted:
            return []
        begin = account.granted - 1
        return list(zip(account.route[begin:], account.steps[begin:], strict=True))

    def start_step(self, robot: str) -> float:
        """Return the step of the last cell that the robot may enter; 0 for a robot without a cell."""
        account = self._accounts.get(robot)
        return account.steps[account.granted - 1] if account and account.granted else 0.0

    def occupied(self, cell: int, but: str) -> list[tuple[float, float]]:
        """Return from which step to which one robots are in a cell, in order.

        Args:
            cell: The cell.
            but: This robot's visits are left out.

        Returns:
            ``(step of entering, step of leaving)``. A cell that is granted already was entered at minus
            infinity; a robot at the end of its route leaves at infinity.
        """
        found = []
        for _, robot, number in self._queues.get(cell, ()):
            if robot == but:
                continue
            account = self._accounts[robot]
            index, steps = number - account.passed, account.steps
            leaves = steps[index + 1] if index + 1 < len(steps) else inf
            found.append((-inf if index < account.granted else steps[index], leaves))
        return found

    def length(self, robot: str) -> int:
        """Return the number of cells of the robot's route; 0 for a robot without a cell."""
        account = self._accounts.get(robot)
        return len(account.route) if account else 0

    def end_of_grant(self, robot: str) -> int | None:
        """Return the last cell that the robot may enter; None for a robot without a cell."""
        account = self._accounts.get(robot)
        return account.route[account.granted - 1] if account and account.granted else None

    def version(self, robot: str) -> int:
        """Return a number that changes when the robot is placed or removed, or its route is cut."""
        account = self._accounts.get(robot)
        return account.version if account else 0

    def overlapped(self, robot: str) -> frozenset[int]:
        """Return cells that the robot overlaps outside its route."""
        account = self._accounts.get(robot)
        return account.extra if account else frozenset()

    def validate(self) -> None:
        """Check the invariants.

        Raises:
            InvariantError: An invariant does not hold.
        """
        owners: dict[int, str] = {}
        for robot, account in self._accounts.items():
            granted = account.route[: account.granted].tolist()
            if len(set(granted)) != len(granted):
                raise InvariantError(f"{robot} was granted a cell twice: {granted}")
            for index, cell in enumerate(granted):
                if self._queues[cell][0] != account.visit(robot, index):
                    raise InvariantError(f"{robot} was granted cell {cell} out of turn")
            for cell in account.claims:
                if owners.setdefault(cell, robot) != robot:
                    raise InvariantError(f"cell {cell} is claimed by {robot} and {owners[cell]}")
            if account.owned != account.claims:
                raise InvariantError(f"{robot} owns {account.owned}, but claims {account.claims}")
        if owners != self._owners:
            raise InvariantError(f"the owners {self._owners} are not the claims {owners}")
        visits = {
            (cell, account.visit(robot, index))
            for robot, account in self._accounts.items()
            for index, cell in enumerate(account.route)
        }
        self._validate_steps()
        queued = [(cell, visit) for cell, queue in self._queues.items() for visit in queue]
        if len(queued) != len(visits) or set(queued) != visits or not all(self._queues.values()):
            raise InvariantError(f"the queues {self._queues} are not the visits {visits}")

    def _validate_steps(self) -> None:
        """Check that steps grow along routes, and along queues behind the granted visits.

        Raises:
            InvariantError: They do not.
        """
        for robot, account in self._accounts.items():
            if len(account.steps) != len(account.route) or list(account.steps) != sorted(set(account.steps)):
                raise InvariantError(f"the steps of {robot} do not grow: {account.steps}")
        for cell in self._queues if self.ordered else ():
            entries = [enters for enters, _ in self.occupied(cell, "") if enters > -inf]
            if any(after <= before for before, after in pairwise(entries)):
                raise InvariantError(f"robots enter cell {cell} out of order: {entries}")
