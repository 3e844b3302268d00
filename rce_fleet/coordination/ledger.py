"""Which robot claims which cell, and which robot enters it next.

A joint plan says at which step robots enter cells. Real robots do not keep these steps, so the plan is
carried out in order: a robot is granted a cell only once every robot that uses the cell before it has left
it. Robots never follow each other in a circle, so one of them can always drive, however slow the others are.

The cost of an operation depends on what it changes, not on the ledger's size: cells have an owner and a
queue, and the ledger records what became possible (:meth:`CellLedger.take_freed`,
:meth:`CellLedger.take_ripe`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING

from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(slots=True)
class _Account:
    """One robot's part of the ledger.

    Attributes:
        route: The cell that it is in, then those it will enter. Empty for a robot without a cell.
        granted: How many cells of the route it may use; the first always.
        extra: Further cells that it overlaps.
        passed: Number of cells that it has left so far; numbers its visits.
        owned: The cells whose owner it is.
        version: Changes whenever the route changes otherwise than by a plan, or by the robot's progress.
    """

    route: list[int] = field(default_factory=list)
    granted: int = 0
    extra: frozenset[int] = frozenset()
    passed: int = 0
    owned: set[int] = field(default_factory=set)
    version: int = 0

    @property
    def claims(self) -> set[int]:
        return {*self.route[: self.granted], *self.extra}


class CellLedger:
    """The record of claims and turns.

    Invariants, checked by :meth:`validate`:

    - the claims of two robots are disjoint;
    - a robot's granted cells are different from each other;
    - a cell's queue begins with the visit of the robot that was granted it;
    - queues hold the visits of all routes, and nothing else.
    """

    def __init__(self) -> None:
        self._accounts: dict[str, _Account] = {}
        self._owners: dict[int, str] = {}
        self._queues: dict[int, deque[tuple[str, int]]] = {}
        self._changed: set[str] = set()
        self._freed: set[int] = set()
        self._ripe: set[str] = set()
        self._versions = count(1)

    # Reading

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
        return account.route[: account.granted] if account else []

    def visitors(self, cell: int) -> set[str]:
        """Return the robots whose routes lead through a cell or begin there."""
        return {robot for robot, _ in self._queues.get(cell, ())}

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

    def extra(self, robot: str) -> frozenset[int]:
        """Return cells that the robot overlaps outside its route."""
        account = self._accounts.get(robot)
        return account.extra if account else frozenset()

    # What became possible

    def take_changed(self) -> set[str]:
        """Return the robots whose route or grant changed since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def take_freed(self) -> set[int]:
        """Return the cells that lost their owner since the last call; they may have a new one by now."""
        freed, self._freed = self._freed, set()
        return freed

    def take_ripe(self) -> set[str]:
        """Return the robots to which :meth:`grant` may grant further cells now; all others get none."""
        ripe, self._ripe = self._ripe, set()
        return ripe

    # Places

    def place(self, robot: str, cell: int, overlaps: Iterable[int] = ()) -> None:
        """Put a robot in a cell; what it claimed before is free again, its route ends there.

        Raises:
            InvariantError: Another robot claims one of the cells; nothing was changed.
        """
        wanted = {cell, *overlaps}
        taken = {other for other in wanted if self._owners.get(other, robot) != robot}
        if taken:
            raise InvariantError(f"{robot} cannot take cells {sorted(taken)} of other robots")
        account = self._account(robot)
        self._withdraw(robot, account)
        account.passed += len(account.route)
        account.version = next(self._versions)
        account.route, account.granted, account.extra = [cell], 1, frozenset(wanted - {cell})
        self._queues.setdefault(cell, deque()).appendleft((robot, account.passed))
        self._changed.add(robot)
        self._settle_owners(robot, account)

    def overlap(self, robot: str, cells: Iterable[int]) -> None:
        """Claim cells for a robot without a cell; skip those that other robots claim."""
        account = self._account(robot)
        if account.route:
            raise InvariantError(f"{robot} has a cell already")
        account.extra = frozenset(cell for cell in cells if self._owners.get(cell, robot) == robot)
        self._settle_owners(robot, account)

    def remove(self, robot: str) -> None:
        """Remove a robot; its cells are free."""
        account = self._account(robot)
        self._withdraw(robot, account)
        account.route, account.granted, account.extra = [], 0, frozenset()
        self._changed.add(robot)
        self._settle_owners(robot, account)
        del self._accounts[robot]

    # Plans

    def truncate(self, robot: str) -> None:
        """Drop the cells of a route that are not granted yet."""
        account = self._account(robot)
        if account.granted == len(account.route):
            return
        for index in range(account.granted, len(account.route)):
            self._drop_visit(account.route[index], (robot, account.passed + index))
        del account.route[account.granted :]
        account.version = next(self._versions)
        self._changed.add(robot)

    def begin_plan(self, starts: Mapping[str, int]) -> None:
        """Begin a new plan where the granted cells end; the rest of older plans is dropped.

        Args:
            starts: For every robot with a plan its last granted cell.

        Raises:
            InvariantError: A robot's start is not its last granted cell; nothing was changed.
        """
        for robot, start in starts.items():
            if self.end_of_grant(robot) != start:
                raise InvariantError(f"the plan of {robot} does not begin where its granted cells end")
        for robot in self._accounts:
            self.truncate(robot)
        self._changed.update(starts)
        self._ripe.update(starts)

    def extend_plan(self, visits: Iterable[tuple[str, int]]) -> None:
        """Add to a plan that was begun.

        Args:
            visits: The cells that robots enter next, in the order of the plan: ``(robot, cell)``.
        """
        accounts, queues = self._accounts, self._queues
        extended: set[str] = set()
        for robot, cell in visits:
            account = accounts[robot]
            route = account.route
            visit = robot, account.passed + len(route)
            queue = queues.get(cell)
            if queue is None:
                queues[cell] = deque((visit,))
            else:
                queue.append(visit)
            route.append(cell)
            extended.add(robot)
        self._changed |= extended
        self._ripe |= extended

    def grant(self, robot: str, ahead: int) -> bool:
        """Grant a robot the next cells of its route, at most ``ahead`` beyond its own.

        Returns:
            Whether there are new ones.
        """
        account = self._account(robot)
        before = account.granted
        while self._may_enter_next(robot, account, ahead):
            cell = account.route[account.granted]
            account.granted += 1
            account.owned.add(cell)
            self._owners[cell] = robot
            self._changed.add(robot)
        return account.granted > before

    def may_grant(self, robot: str, ahead: int) -> bool:
        """Return whether :meth:`grant` would grant a robot a further cell."""
        return self._may_enter_next(robot, self._account(robot), ahead)

    def arrive(self, robot: str, index: int) -> None:
        """Record that a robot has fully arrived in granted cell number ``index`` and overlaps no other."""
        account = self._account(robot)
        if not 0 <= index < account.granted:
            raise InvariantError(f"{robot} arrived in a cell that it was not granted")
        if index == 0 and not account.extra:
            return
        for cell in account.route[:index]:
            queue = self._queues[cell]
            if queue.popleft() != (robot, account.passed):
                raise InvariantError(f"{robot} left cell {cell} out of turn")
            if not queue:
                del self._queues[cell]
            account.passed += 1
        del account.route[:index]
        account.granted -= index
        account.extra = frozenset()
        if index:
            self._changed.add(robot)
            self._ripe.add(robot)
        self._settle_owners(robot, account)

    # Consistency

    def validate(self) -> None:
        """Check the invariants.

        Raises:
            InvariantError: An invariant does not hold.
        """
        owners: dict[int, str] = {}
        for robot, account in self._accounts.items():
            granted = account.route[: account.granted]
            if len(set(granted)) != len(granted):
                raise InvariantError(f"{robot} was granted a cell twice: {granted}")
            for index, cell in enumerate(granted):
                if self._queues[cell][0] != (robot, account.passed + index):
                    raise InvariantError(f"{robot} was granted cell {cell} out of turn")
            for cell in account.claims:
                if owners.setdefault(cell, robot) != robot:
                    raise InvariantError(f"cell {cell} is claimed by {robot} and {owners[cell]}")
            if account.owned != account.claims:
                raise InvariantError(f"{robot} owns {account.owned}, but claims {account.claims}")
        if owners != self._owners:
            raise InvariantError(f"the owners {self._owners} are not the claims {owners}")
        visits = {
            (cell, (robot, account.passed + index))
            for robot, account in self._accounts.items()
            for index, cell in enumerate(account.route)
        }
        queued = [(cell, visit) for cell, queue in self._queues.items() for visit in queue]
        if len(queued) != len(visits) or set(queued) != visits or not all(self._queues.values()):
            raise InvariantError(f"the queues {self._queues} are not the visits {visits}")

    def _account(self, robot: str) -> _Account:
        return self._accounts.setdefault(robot, _Account())

    def _may_enter_next(self, robot: str, account: _Account, ahead: int) -> bool:
        if account.granted >= min(len(account.route), ahead + 1):
            return False
        cell = account.route[account.granted]
        is_first = self._queues[cell][0] == (robot, account.passed + account.granted)
        # A robot can drive over a cell twice; it is granted it again once it has left it.
        return is_first and self._owners.get(cell, robot) == robot

    def _withdraw(self, robot: str, account: _Account) -> None:
        """Remove all visits of a robot from the queues."""
        for index, cell in enumerate(account.route):
            self._drop_visit(cell, (robot, account.passed + index))

    def _drop_visit(self, cell: int, visit: tuple[str, int]) -> None:
        queue = self._queues[cell]
        was_first = queue[0] == visit
        queue.remove(visit)
        if not queue:
            del self._queues[cell]
        elif was_first:
            self._ripe.add(queue[0][0])

    def _settle_owners(self, robot: str, account: _Account) -> None:
        """Make a robot the owner of exactly the cells that it claims."""
        claims = account.claims
        for cell in account.owned - claims:
            del self._owners[cell]
            self._freed.add(cell)
            queue = self._queues.get(cell)
            if queue:
                self._ripe.add(queue[0][0])
        self._owners.update(dict.fromkeys(claims, robot))
        account.owned = claims
