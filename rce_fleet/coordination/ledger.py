"""Which robot claims which cell, and which robot enters it next.

A joint plan says at which step robots enter cells. Real robots do not keep these steps, so the plan is
carried out in order: a robot is granted a cell only once every robot that uses the cell before it has left
it. Robots never follow each other in a circle, so one of them can always drive, however slow the others are.

Each visit has a *step*: its time in the plan. Steps grow along a route and along a cell's queue, so a path
that keeps to the steps between others' visits can be added to a plan without changing it (see
:mod:`rce_fleet.coordination.repair`).

A ledger that is not ``ordered`` grants a cell to whichever robot asks first. Robots still never meet, but
they can wait for each other in a circle (see :mod:`rce_fleet.coordination.waiting`).

The cost of an operation depends on what it changes, not on the ledger's size: cells have an owner and a
queue, and the ledger records what became possible (:meth:`CellLedger.take_freed`,
:meth:`CellLedger.take_ripe`).
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import deque
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.ledger_view import AFTER_ALL, CELLS, STEPS, Account, LedgerView, QueuedVisit
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from collections.abc import Set as AbstractSet


class CellLedger(LedgerView):
    """The record of claims and turns; see :class:`~rce_fleet.coordination.ledger_view.LedgerView`."""

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
        account.route, account.granted, account.extra = array(CELLS, (cell,)), 1, frozenset(wanted - {cell})
        following = [enters for enters, _ in self.occupied(cell, robot)]
        account.steps = array(STEPS, (min([self.clock, *(enters - 1.0 for enters in following)]),))
        self._queues.setdefault(cell, deque()).appendleft(account.visit(robot, 0))
        self._changed.add(robot)
        self._settle_owners(robot, account)

    def overlap(self, robot: str, cells: Iterable[int]) -> None:
        """Claim cells beside a robot's granted ones, instead of such cells before; skip those of others."""
        account = self._account(robot)
        account.extra = frozenset(cell for cell in cells if self._owners.get(cell, robot) == robot)
        self._settle_owners(robot, account)

    def remove(self, robot: str) -> None:
        """Remove a robot; its cells are free."""
        account = self._account(robot)
        self._withdraw(robot, account)
        account.clear()
        self._changed.add(robot)
        self._settle_owners(robot, account)
        del self._accounts[robot]

    def unplace(self, robot: str) -> None:
        """Take a robot's cells from it; it stays in the ledger, and can claim cells by :meth:`overlap`."""
        account = self._account(robot)
        self._withdraw(robot, account)
        account.passed += len(account.route)
        account.version = next(self._versions)
        account.clear()
        self._changed.add(robot)
        self._settle_owners(robot, account)

    # Plans

    def truncate(self, robot: str, keep: int = 0) -> None:
        """Drop the end of a route: all but the first ``keep`` cells and those that are granted."""
        account = self._account(robot)
        keep = max(keep, account.granted)
        if keep >= len(account.route):
            return
        for index in range(keep, len(account.route)):
            self._drop_visit(account.route[index], account.visit(robot, index))
        del account.route[keep:], account.steps[keep:]
        account.version = next(self._versions)
        self._changed.add(robot)

    def begin_plan(self, starts: Mapping[str, int], *, ordered: bool = True) -> None:
        """Begin a new plan where the granted cells end; the rest of older plans is dropped.

        Args:
            starts: For every robot with a plan its last granted cell.
            ordered: Whether the plan's order is kept.

        Raises:
            InvariantError: A robot's start is not its last granted cell; nothing was changed.
        """
        for robot, start in starts.items():
            if self.end_of_grant(robot) != start:
                raise InvariantError(f"the plan of {robot} does not begin where its granted cells end")
        self._drop_horizons()
        self.ordered = ordered
        self.clock = self._last_step = self._last_step + 1.0
        self._changed.update(starts)
        self._ripe.update(starts)

    def _drop_horizons(self) -> None:
        """End all routes with their granted cells. Each granted cell is in one route, so queues are short."""
        self._queues.clear()
        for robot, account in self._accounts.items():
            granted = account.granted
            if granted < len(account.route):
                del account.route[granted:], account.steps[granted:]
                account.version = next(self._versions)
                self._changed.add(robot)
            for index, cell in enumerate(account.route):
                self._queues[cell] = deque((account.visit(robot, index),))

    def extend_plan(self, visits: Iterable[tuple[str, int, int]]) -> None:
        """Add to a plan that was begun.

        Args:
            visits: The cells that robots enter next, in the order of the plan: ``(robot, cell, step)``, with
                steps counted from the plan's beginning.
        """
        accounts, queues, begin = self._accounts, self._queues, self.clock
        extended: set[str] = set()
        last = self._last_step
        for robot, cell, step in visits:
            account = accounts[robot]
            route = account.route
            visit = begin + step, robot, account.passed + len(route)
            queue = queues.get(cell)
            if queue is None:
                queues[cell] = deque((visit,))
            else:
                queue.append(visit)
            route.append(cell)
            account.steps.append(begin + step)
            extended.add(robot)
            last = max(last, begin + step)
        self._last_step = last
        self._changed |= extended
        self._ripe |= extended

    def insert(self, robot: str, visits: Iterable[tuple[int, float]]) -> None:
        """Add cells to the end of one robot's route, between the visits of the others.

        Args:
            robot: The robot.
            visits: ``(cell, step)`` in order, with steps of the ledger.

        Raises:
            InvariantError: A step is not greater than the one before it.
        """
        account = self._account(robot)
        route, steps, queues = account.route, account.steps, self._queues
        last = steps[-1] if steps else -inf
        number = account.passed + len(route)
        for cell, step in visits:
            if step <= last:
                raise InvariantError(f"{robot} enters cell {cell} at step {step}, not after {last}")
            visit = step, robot, number
            queue = queues.get(cell)
            if queue is None:
                queues[cell] = deque((visit,))
            elif queue[-1][0] <= step or not self.ordered:
                queue.append(visit)
            else:
                queue.insert(self._position(queue, step), visit)
            route.append(cell)
            steps.append(step)
            number += 1
            last = step
        self._last_step = max(self._last_step, last)
        account.version = next(self._versions)
        self._changed.add(robot)
        self._ripe.add(robot)

    def _position(self, queue: deque[QueuedVisit], step: float) -> int:
        """Return the place in an ordered queue of a visit at ``step``: behind granted and earlier ones."""
        _, robot, number = queue[0]
        account = self._accounts[robot]
        # Only the first visit can be granted, whatever its step is; the steps behind it grow.
        is_granted = number - account.passed < account.granted
        return bisect_right(queue, (step, AFTER_ALL, 0), lo=int(is_granted))

    def grant(self, robot: str, ahead: int) -> bool:
        """Grant a robot the next cells of its route, at most ``ahead`` beyond its own.

        Returns:
            Whether there are new ones.
        """
        account = self._account(robot)
        before = account.granted
        while self._may_enter_next(robot, account, ahead):
            cell = account.route[account.granted]
            if not self.ordered:
                visit = account.visit(robot, account.granted)
                self._queues[cell].remove(visit)
                self._queues[cell].appendleft(visit)
            account.granted += 1
            account.owned.add(cell)
            self._owners[cell] = robot
            self._changed.add(robot)
        return account.granted > before

    def may_grant(self, robot: str, ahead: int) -> bool:
        """Return whether :meth:`grant` would grant a robot a further cell."""
        return self._may_enter_next(robot, self._account(robot), ahead)

    def arrive(self, robot: str, index: int, still: AbstractSet[int] = frozenset()) -> None:
        """Record that a robot has fully arrived in granted cell number ``index``.

        Args:
            robot: The robot.
            index: Number of the cell on its route.
            still: Cells that it still overlaps outside of its route.
        """
        account = self._account(robot)
        if not 0 <= index < account.granted:
            raise InvariantError(f"{robot} arrived in a cell that it was not granted")
        if index == 0 and account.extra <= still:
            return
        for cell, step in zip(account.route[:index], account.steps[:index], strict=True):
            queue = self._queues[cell]
            if queue.popleft() != (step, robot, account.passed):
                raise InvariantError(f"{robot} left cell {cell} out of turn")
            if not queue:
                del self._queues[cell]
            account.passed += 1
        self.clock = max(self.clock, account.steps[index])
        del account.route[:index], account.steps[:index]
        account.granted -= index
        account.extra &= still
        if index:
            self._changed.add(robot)
            self._ripe.add(robot)
        self._settle_owners(robot, account)

    def _account(self, robot: str) -> Account:
        return self._accounts.setdefault(robot, Account())

    def _may_enter_next(self, robot: str, account: Account, ahead: int) -> bool:
        if account.granted >= min(len(account.route), ahead + 1):
            return False
        cell = account.route[account.granted]
        if not self.ordered:
            return cell not in self._owners
        is_first = self._queues[cell][0] == account.visit(robot, account.granted)
        # A robot can drive over a cell twice; it is granted it again once it has left it.
        return is_first and self._owners.get(cell, robot) == robot

    def _withdraw(self, robot: str, account: Account) -> None:
        """Remove all visits of a robot from the queues."""
        for index, cell in enumerate(account.route):
            self._drop_visit(cell, account.visit(robot, index))

    def _drop_visit(self, cell: int, visit: QueuedVisit) -> None:
        queue = self._queues[cell]
        was_first = queue[0] == visit
        queue.remove(visit)
        if not queue:
            del self._queues[cell]
        elif was_first:
            self._ripen(cell)

    def _ripen(self, cell: int) -> None:
        """Note the robots that may be granted a cell now."""
        queue = self._queues.get(cell)
        if queue and self.ordered:
            self._ripe.add(queue[0][1])
        elif queue:
            self._ripe.update(robot for _, robot, _ in queue)

    def _settle_owners(self, robot: str, account: Account) -> None:
        """Make a robot the owner of exactly the cells that it claims."""
        claims = account.claims
        for cell in account.owned - claims:
            del self._owners[cell]
            self._freed.add(cell)
            self._ripen(cell)
        self._owners.update(dict.fromkeys(claims, robot))
        account.owned = claims
