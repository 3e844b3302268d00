"""Moves for which robots have waited of late cost more in later paths, so that robots spread out.

The planner looks once a second for robots that stand with a path and no cell to drive to. What it counts
fades (:mod:`rce_fleet.planning.congestion`); a move costs a whole number of steps, ``MOST`` at most.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.coordination.robot import Phase
from rce_fleet.planning.congestion import Congestion, CongestionSettings
from rce_fleet.planning.graph import PlanningGraph

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState

EVERY = 1.0
"""Seconds between two looks at robots that wait; one look is a step of the counts."""
MOST = 3
"""Steps that a move costs at most."""
HALF_LIFE = 120.0
"""Seconds after which a wait counts half."""
_WEIGHT = 4.0
"""A move for which a robot waits a quarter of the time costs one step more."""


class LearnedCosts:
    """Learns what moves cost where robots wait.

    Args:
        state: The fleet; its ``learned`` costs are set.
    """

    def __init__(self, state: FleetState) -> None:
        self._state = state
        self._graph = PlanningGraph.from_grid(state.grid)
        settings = CongestionSettings(half_life=HALF_LIFE / EVERY, most=MOST, weight=_WEIGHT, units=1)
        self._congestion = Congestion(self._graph, settings)
        self._froms = np.repeat(np.arange(len(self._graph)), np.diff(self._graph.indptr))
        self._looked_at = -inf

    def look(self, now: float) -> None:
        """Count the robots that wait, once a second, and set the costs."""
        if now - self._looked_at < EVERY:
            return
        self._looked_at = now
        ledger = self._state.ledger
        moves = [
            tuple(ledger.route(record.id)[:2])
            for record in self._state.robots.values()
            if record.phase is Phase.ACTIVE
            and record.centred
            and len(ledger.granted(record.id)) == 1 < ledger.length(record.id)
        ]
        self._congestion.observe([here for here, _ in moves], [there for _, there in moves])
        costs = self._congestion.graph().costs
        edges = np.flatnonzero(costs > 1)
        ends = self._graph.neighbours[edges]
        self._state.learned = dict(
            zip(
                zip(self._froms[edges].tolist(), ends.tolist(), strict=True),
                costs[edges].tolist(),
                strict=True,
            )
        )
