"""Whether the other side of a connection still takes part.

The signs of life are in :mod:`.signs`, what watches a connection for them is in :mod:`.watch`, and
:mod:`.websocket` has connections of the ``websockets`` library that are watched.
"""

from __future__ import annotations

from rce.liveness.signs import Liveness, Outflow, Step
from rce.liveness.watch import Watch, Watched

__all__ = ["Liveness", "Outflow", "Step", "Watch", "Watched"]
