"""Time in which something could have happened: what silence is measured in."""

from __future__ import annotations

from collections.abc import Callable


class PatientClock:
    """Seconds that passed both for this machine and for the graph.

    With simulated time, others do nothing while it stands still, and little while it creeps; a jump is no
    time at all that they had. Where time is not simulated, both are the same.
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
