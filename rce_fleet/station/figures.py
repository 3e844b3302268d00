"""Figures of the fleet over time: what robots do, and the fleet manager's statistics of the last ten minutes.

They are sampled while the station runs and kept beside the records for replays, so that a page that is opened
in the middle of a shift shows the hours before.
"""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, Any

from rce_fleet.station.planner_client import PlannerUnavailableError

if TYPE_CHECKING:
    from rce_fleet.station.recording import Records
    from rce_fleet.station.view import FleetView

_log = logging.getLogger(__name__)

SAMPLE_EVERY_S = 5.0
STATISTICS_PATH = "/statistics?seconds=600"
MAX_POINTS = 720
"""Most samples in one answer."""
OF_MANAGER = {
    "battery": "battery_mean",
    "done": "tasks_per_hour",
    "open": "tasks_open",
    "utilization": "utilization",
    "wait": "waiting_s",
    "late": "late",
}
"""Names of figures, and of the manager's statistics that they are."""
OF_PLANNER = {"moving": "driving", "waiting": "waiting"}
"""Names of figures that count robots, and of the robots' states."""

Figures = dict[str, float]
AskStatistics = Callable[[], Awaitable[dict[str, Any] | None]]


class FigureRecorder:
    """Samples the figures of a fleet.

    Args:
        view: The state of the fleet.
        records: Where samples are kept.
        ask: Returns the manager's statistics; None if there are none now.
    """

    def __init__(self, view: FleetView, records: Records, ask: AskStatistics) -> None:
        self._view = view
        self._records = records
        self._ask = ask

    async def run(self) -> None:
        """Sample until cancelled. On a full disk, it begins anew once there is room."""
        fails = False
        while True:
            await asyncio.sleep(SAMPLE_EVERY_S)
            figures = await self.sample()
            if not figures:
                continue
            try:
                await asyncio.to_thread(self._records.add_figures, time.time(), figures)
            except sqlite3.Error as error:
                if not fails:
                    _log.warning("figures are not recorded now: %s", error)
                fails = True
            else:
                fails = False

    async def sample(self) -> Figures:
        """Return the figures of this moment; empty before the first state of the fleet."""
        if self._view.map() is None:
            return {}
        states = [robot["state"] for robot in self._view.robots()]
        figures: Figures = {name: states.count(state) for name, state in OF_PLANNER.items()}
        try:
            statistics = await self._ask() or {}
        except PlannerUnavailableError:
            statistics = {}
        told = {name: statistics.get(key) for name, key in OF_MANAGER.items()}
        return figures | {name: value for name, value in told.items() if value is not None}


def columns_of(samples: Sequence[tuple[float, Figures]]) -> tuple[list[float], dict[str, list[float | None]]]:
    """Return times and figures of samples, thinned to at most :data:`MAX_POINTS`; the newest is among them.

    Returns:
        Seconds since 1970, and for each figure a value for each of them; None where it was not known.
    """
    step = max(1, -(-len(samples) // MAX_POINTS))
    kept = samples[::-1][::step][::-1]
    names = sorted({name for _, figures in kept for name in figures})
    return [at for at, _ in kept], {name: [figures.get(name) for _, figures in kept] for name in names}
