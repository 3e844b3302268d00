"""Requested goals and blocked cells, to send them again to a restarted planner, and nodes to restart.

A fleet without its planner stands still, so the operator's nodes are started again when they end. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, assert_never

from rce.config.client import ClientConfig
from rce.model import ConfigureComponents, RemoveNode, Request

_ENDED = frozenset({"failed", "exited"})
_UP = frozenset({"running", "degraded"})


@dataclass(frozen=True, slots=True)
class DesiredGoal:
    """A robot shall drive to a cell."""

    robot: str
    cell: int


@dataclass(frozen=True, slots=True)
class DesiredCell:
    """A cell shall be blocked, or free.

    Attributes:
        cell: The cell.
        blocked: Whether it shall be blocked.
        user: Who blocked it.
        reason: Why, for people.
        since: When it was blocked, seconds since 1970; None: now.
        until: When it is freed, seconds since 1970; None: it stays blocked.
    """

    cell: int
    blocked: bool
    user: str = ""
    reason: str = ""
    since: float | None = None
    until: float | None = None

    def has_ended(self, now: float) -> bool:
        """Return whether its time has come, at ``now`` in seconds since 1970."""
        return self.until is not None and self.until <= now

    def request(self, now: float) -> dict[str, Any]:
        """Return a ``fleet/BlockCell`` request, at ``now`` in seconds since 1970."""
        told = {
            "by": self.user,
            "reason": self.reason,
            "age": 0.0 if self.since is None else max(now - self.since, 0.0),
            "lifetime": 0.0 if self.until is None else max(self.until - now, 0.001),
        }
        # Planners of earlier releases do not know these fields.
        given = {name: value for name, value in told.items() if value} if self.blocked else {}
        return {"cell": self.cell, "blocked": self.blocked, **given}


class Desired:
    """The newest request for each robot and each cell."""

    def __init__(self) -> None:
        self._goals: dict[str, int] = {}
        self._cells: dict[int, DesiredCell] = {}

    def set_goal(self, robot: str, cell: int | None) -> None:
        """Store a goal that the planner accepted; None removes it."""
        if cell is None:
            self._goals.pop(robot, None)
        else:
            self._goals[robot] = cell

    def set_cell(self, wanted: DesiredCell) -> None:
        """Store that the planner blocked or freed a cell."""
        self._cells[wanted.cell] = wanted

    def forget_cell(self, cell: int) -> None:
        """Forget a cell: the fleet manager keeps it."""
        self._cells.pop(cell, None)

    def forget_goal(self, robot: str) -> None:
        """Forget a goal: the fleet manager keeps it."""
        self._goals.pop(robot, None)

    def clear(self) -> None:
        """Forget everything: the cells have other numbers now, or the fleet manager keeps goals and cells."""
        self._goals.clear()
        self._cells.clear()

    def holds(self, desired: DesiredCell | DesiredGoal) -> bool:
        """Return whether this is still the newest request for its robot or cell."""
        match desired:
            case DesiredCell(cell):
                return self._cells.get(cell) == desired
            case DesiredGoal(robot, cell):
                return self._goals.get(robot) == cell
            case _:
                assert_never(desired)

    def unmet(self, state: dict[str, Any], now: float = 0.0) -> list[DesiredCell | DesiredGoal]:
        """Return what is missing in a planner's state.

        Cells come first, so that no path is planned through them. Robots that the planner does not know yet,
        or that have another goal, are left out, and cells whose time has come.

        Args:
            state: A ``fleet/FleetState`` in its JSON form.
            now: Seconds since 1970.
        """
        shut = {*state["blocked"], *state["pending"]}
        cells = [
            wanted
            for cell, wanted in self._cells.items()
            if wanted.blocked != (cell in shut) and cell not in state["walls"] and not wanted.has_ended(now)
        ]
        goals = [
            DesiredGoal(robot["id"], self._goals[robot["id"]])
            for robot in state["robots"]
            if robot["id"] in self._goals and robot["goal"] < 0
        ]
        return [*cells, *goals]


def node_requests(config: ClientConfig, engine: dict[str, Any]) -> list[Request]:
    """Return the requests to the engine that make all nodes of ``config`` run.

    A node that ended is removed first; once the engine does not report it any more, it is added again.

    Args:
        config: The operator's config.
        engine: The engine's state, as :class:`~rce_fleet.station.engine_watch.EngineWatch` reports it.
    """
    requests: list[Request] = []
    for container in engine.get("containers", ()):
        if container["state"] not in _UP:
            continue
        states = {node["tag"]: node["state"] for node in container["nodes"]}
        for add in config.nodes:
            if add.container != container["tag"]:
                continue
            if add.node.tag not in states:
                requests.append(ConfigureComponents(add_nodes=(add,)))
            elif states[add.node.tag] in _ENDED:
                remove = RemoveNode(container=add.container, tag=add.node.tag)
                requests.append(ConfigureComponents(remove_nodes=(remove,)))
    return requests
