"""Who claims which cell, and who is next to enter it.

A joint plan says at which step robots enter cells. Real robots keep no steps, so the plan is carried out
by order: a robot is granted a cell only once everybody who is to use the cell before has left it. Because
nobody in a plan follows others around in a circle, somebody can always go on, however slow the others are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(slots=True)
class _Account:
    """One robot's part of the ledger.

    Attributes:
        route: The cell that it is in, then those it will enter. Empty for a robot without a place.
        granted: How many cells of the route it may use; the first always.
        extra: Further cells that it overlaps.
        passed: How many cells of its life it has left; numbers its visits.
    """

    route: list[int] = field(default_factory=list)
    granted: int = 0
    extra: frozenset[int] = frozenset()
    passed: int = 0

    @property
    def claims(self) -> set[int]:
        return {*self.route[: self.granted], *self.extra}


class CellLedger:
    """The books of claims and turns.

    Invariants, checked by :meth:`validate`:

    - the claims of two robots are disjoint;
    - a robot's granted cells are different from each other;
    - a cell's queue begins with the visit of the robot that was granted it.
    """

    def __init__(self) -> None:
        self._accounts: dict[str, _Account] = {}
        self._owners: dict[int, str] = {}
        self._queues: dict[int, deque[tuple[str, int]]] = {}

    # -- reading --------------------------------------------------------------------------------

    def claims(self, robot: str) -> frozenset[int]:
        """Cells that are the robot's now."""
        account = self._accounts.get(robot)
        return frozenset(account.claims) if account else frozenset()

    def owner(self, cell: int) -> str | None:
        """The robot that claims a cell."""
        return self._owners.get(cell)

    def route(self, robot: str) -> list[int]:
        """The robot's cell and all cells that it will enter."""
        account = self._accounts.get(robot)
        return list(account.route) if account else []

    def granted(self, robot: str) -> list[int]:
        """The robot's cell and the cells that it may enter now."""
        account = self._accounts.get(robot)
        return account.route[: account.granted] if account else []

    def extra(self, robot: str) -> frozenset[int]:
        """Cells that the robot overlaps without being on its way through them."""
        account = self._accounts.get(robot)
        return account.extra if account else frozenset()

    # -- places ---------------------------------------------------------------------------------

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
        account.route, account.granted, account.extra = [cell], 1, frozenset(wanted - {cell})
        self._queues.setdefault(cell, deque()).appendleft((robot, account.passed))
        self._settle_owners(robot, account)

    def overlap(self, robot: str, cells: Iterable[int]) -> None:
        """Claim for a robot without a place those cells that nobody else claims."""
        account = self._account(robot)
        if account.route:
            raise InvariantError(f"{robot} has a place")
        account.extra = frozenset(cell for cell in cells if self._owners.get(cell, robot) == robot)
        self._settle_owners(robot, account)

    def remove(self, robot: str) -> None:
        """Forget a robot; its cells are free."""
        account = self._account(robot)
        self._withdraw(robot, account)
        account.route, account.granted, account.extra = [], 0, frozenset()
        self._settle_owners(robot, account)
        del self._accounts[robot]

    # -- plans ----------------------------------------------------------------------------------

    def truncate(self, robot: str) -> None:
        """Drop what a robot was not yet granted."""
        account = self._account(robot)
        for index in range(account.granted, len(account.route)):
            self._queues[account.route[index]].remove((robot, account.passed + index))
        del account.route[account.granted :]

    def adopt(self, routes: Mapping[str, list[tuple[int, int]]]) -> None:
        """Take a new plan. It begins where the granted cells end; the rest of older plans is dropped.

        Args:
            routes: For every robot with a plan ``(step, cell)``, its last granted cell first.
        """
        for robot in self._accounts:
            self.truncate(robot)
        pending_logins: list[tuple[int, str, int]] = []
        for robot, route in routes.items():
            if route[0][1] != self._accounts[robot].route[-1]:
                raise InvariantError(f"the plan of {robot} does not begin where its granted cells end")
            pending_logins.extend((step, robot, cell) for step, cell in route[1:])
        for _, robot, cell in sorted(pending_logins):
            account = self._accounts[robot]
            self._queues.setdefault(cell, deque()).append((robot, account.passed + len(account.route)))
            account.route.append(cell)

    def grant(self, robot: str, ahead: int) -> bool:
        """Grant a robot the next cells of its route, at most ``ahead`` beyond its own.

        Returns:
            Whether there are new ones.
        """
        account = self._account(robot)
        before = account.granted
        while account.granted < min(len(account.route), ahead + 1):
            cell = account.route[account.granted]
            if self._queues[cell][0] != (robot, account.passed + account.granted):
                break
            if self._owners.get(cell, robot) != robot:
                break
            account.granted += 1
            self._owners[cell] = robot
        return account.granted > before

    def arrive(self, robot: str, index: int) -> None:
        """The robot has fully arrived in granted cell number ``index`` and overlaps no other."""
        account = self._account(robot)
        if not 0 <= index < account.granted:
            raise InvariantError(f"{robot} arrived in a cell that it was not granted")
        for cell in account.route[:index]:
            if self._queues[cell].popleft() != (robot, account.passed):
                raise InvariantError(f"{robot} left cell {cell} out of turn")
            account.passed += 1
        del account.route[:index]
        account.granted -= index
        account.extra = frozenset()
        self._settle_owners(robot, account)

    # -- books ----------------------------------------------------------------------------------

    def validate(self) -> None:
        """Check the invariants.

        Raises:
            InvariantError: One does not hold.
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
        if owners != self._owners:
            raise InvariantError(f"the owners {self._owners} are not the claims {owners}")

    def _account(self, robot: str) -> _Account:
        return self._accounts.setdefault(robot, _Account())

    def _withdraw(self, robot: str, account: _Account) -> None:
        """Take all visits of a robot out of the queues."""
        for index, cell in enumerate(account.route):
            self._queues[cell].remove((robot, account.passed + index))

    def _settle_owners(self, robot: str, account: _Account) -> None:
        claims = account.claims
        for cell in [cell for cell, owner in self._owners.items() if owner == robot and cell not in claims]:
            del self._owners[cell]
        self._owners.update(dict.fromkeys(claims, robot))
