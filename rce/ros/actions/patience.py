"""A clock for measuring silence, by machine time and ROS time."""

from __future__ import annotations

from collections.abc import Callable


class PatientClock:
    """Seconds that passed both for this machine and for the graph.

    While simulated time stands still or runs slowly, other nodes do little; a jump gives them no time at all.
    If time is not simulated, both are the same.
    """

    def __init__(self, machine: Callable[[], float], graph: Callable[[], float]) -> None:
        """Begin at the machine's time.

        Args:
            machine: This machine's time in seconds; never goes back.
            graph: ROS time in seconds.
        """
        self._machine, self._graph = machine, graph
        self._now = self._seen_machine = machine()
        self._seen_graph = graph()

    def now(self) -> float:
        """Return the time; it never goes back. To be asked often: only the sum since then is looked at."""
        machine, graph = self._machine(), self._graph()
        passed = min(machine - self._seen_machine, graph - self._seen_graph)
        self._seen_machine, self._seen_graph = machine, graph
        self._now += max(0.0, passed)
        return self._now
