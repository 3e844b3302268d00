"""Keeps the robots of a fleet, and the cells that each may be in, for the planner after this one.

They are in a file on the container's volume ``fleet``, so a planner whose container was killed claims the
cells of robots that it has not heard yet.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.nodes.kept_pose import boot_id

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.planning.grid import GridMap

VOLUME_VARIABLE = "RCE_VOLUME_FLEET"
"""Where the container has its volume with the name ``fleet``, if it has one."""
FILE = "robots.json"
KNOWN_FOR = 3600.0
"""Seconds; robots of an older file of the same start of the machine may have been moved by hand."""
WRITTEN_EVERY = 600.0
"""Seconds after which the file of robots at rest is written again, so that it does not become old."""


def uptime() -> float:
    """Return the seconds since the machine was started: a clock that is never set."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def file_of_robots(values: Mapping[str, Any]) -> Path | None:
    """Return the file that the parameter ``known_robots`` names, or that is on the volume; None without."""
    named = str(values.get("known_robots", ""))
    if named:
        return Path(named)
    folder = os.environ.get(VOLUME_VARIABLE, "")
    return Path(folder, FILE) if folder else None


def cells_of_robots(state: FleetState, ahead: int) -> dict[str, tuple[int, ...]]:
    """Return the cells that each robot may be in soon: those that it claims, and the next of its path.

    Args:
        state: The fleet.
        ahead: Cells that are granted at most beyond a robot's own; so many more are returned, because the
            file is written a little later than cells are granted.
    """
    return {
        robot: tuple(sorted({*state.ledger.claims(robot), *state.ledger.route(robot)[: 2 * ahead + 1]}))
        for robot in sorted(state.robots)
    }


class KnownRobots:
    """The file.

    Args:
        path: Its path.
        ahead: Cells that are granted at most beyond a robot's own.
        boot: Which start of the machine this is; by default, as the system says.
    """

    def __init__(self, path: Path, ahead: int, boot: str | None = None) -> None:
        self._path = path
        self._ahead = ahead
        self._boot = boot_id() if boot is None else boot
        self._written: dict[str, Any] = {}
        self._written_at = 0.0

    def read(self, grid: GridMap, now: float) -> tuple[dict[str, tuple[int, ...]], str]:
        """Return the cells that each robot may be in, and what a person should know of them.

        How old a file of an earlier start of the machine is, only the wall clock says, which may be wrong:
        its robots count.

        Args:
            grid: The fleet's grid.
            now: Seconds since the machine was started.

        Returns:
            The cells, none if the file is of another grid, or old; and a remark, empty without one.

        Raises:
            ValueError: The file does not hold robots; the text says what it holds.
            OSError: The file cannot be read.
        """
        if not self._path.exists():
            return {}, ""
        try:
            found = json.loads(self._path.read_text(encoding="utf-8"))
            robots = {str(robot): tuple(map(int, cells)) for robot, cells in found["robots"].items()}
            is_same_grid = found["grid"] == _describe(grid)
            is_same_start = bool(self._boot) and found.get("boot") == self._boot
            age = now - float(found["written"])
        except (KeyError, TypeError, AttributeError, json.JSONDecodeError) as error:
            raise ValueError(
                f"{self._path} does not hold the robots of a fleet ({error!r}): it is written anew"
            ) from error
        names = ", ".join(sorted(robots))
        if not is_same_grid or not robots:
            return {}, ""
        if not is_same_start:
            return robots, (
                f"{self._path} is of an earlier start of the machine: the cells of {names} are claimed "
                "until these robots are heard; remove those that are not on the floor any more"
            )
        if not age <= KNOWN_FOR:
            return {}, (
                f"{self._path} is {age / 3600:.1f} h old and is ignored: check where {names} stand "
                "if they are not heard"
            )
        return robots, ""

    def content(self, state: FleetState, now: float) -> dict[str, Any] | None:
        """Return what to write; None if the file has it already, and not for long.

        Args:
            state: The fleet.
            now: Seconds since the machine was started.
        """
        robots = {robot: list(cells) for robot, cells in cells_of_robots(state, self._ahead).items()}
        content = {"grid": _describe(state.grid), "robots": robots}
        is_new = now - self._written_at <= WRITTEN_EVERY
        return None if is_new and content == self._written else content

    def write(self, content: dict[str, Any], now: float) -> None:
        """Replace the file.

        Args:
            content: As :meth:`content` returned it.
            now: Seconds since the machine was started.

        Raises:
            OSError: It cannot be written.
        """
        beside = self._path.with_suffix(".new")
        with beside.open("w", encoding="utf-8") as file:
            json.dump({**content, "boot": self._boot, "written": now}, file)
            file.flush()
            os.fsync(file.fileno())  # after a power cut the name must not stand for an empty file
        beside.replace(self._path)
        self._written, self._written_at = content, now


def _describe(grid: GridMap) -> list[float]:
    return [grid.rows, grid.columns, grid.cell_size, *grid.origin, grid.yaw]
