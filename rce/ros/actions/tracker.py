"""An action client's state of one goal, and the clock that measures a server's silence.

Pure: takes events and the time, and returns the states passed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rce.ros.actions.exceptions import IllegalTransitionError
from rce.ros.actions.states import CLIENT_TRANSITIONS, CommState, GoalState

REPEAT_AFTER = 1.0
"""Seconds after which a goal or a cancellation that the server does not show to know is sent again.

The server takes a goal that comes twice as one; so a message that was lost does no harm.
"""

_FORGOTTEN = "the server does not list the goal any longer"
_SILENT = "the server is silent"
_NO_RESULT = "the goal is over, but its result did not come"

_ENDING = frozenset({CommState.WAITING_FOR_RESULT, CommState.RECALLING, CommState.PREEMPTING, CommState.DONE})


@dataclass(slots=True)
class GoalTracker:
    """One goal of a client. Times are seconds of any clock that does not jump.

    Attributes:
        goal_id: Which goal.
        since: When the communication state began.
        comm: The communication state.
        state: The goal's state, as the server last said.
        text: The server's text on its state.
        is_acknowledged: Whether the server has ever listed the goal.
        sent_at: When the goal, or its cancellation, was sent last.
    """

    goal_id: str
    since: float
    sent_at: float
    comm: CommState = CommState.WAITING_FOR_GOAL_ACK
    state: GoalState = GoalState.PENDING
    text: str = ""
    is_acknowledged: bool = False

    @property
    def is_done(self) -> bool:
        """Whether nothing more will happen."""
        return self.comm is CommState.DONE

    def listed(self, state: GoalState, text: str, now: float) -> tuple[CommState, ...]:
        """Take the goal's entry in the server's list.

        Returns:
            The communication states that were passed, the present one last; empty if nothing changed.

        Raises:
            IllegalTransitionError: The transition is illegal; nothing was changed.
        """
        if self.is_done:
            return ()
        row = CLIENT_TRANSITIONS[self.comm]
        passed = row.get(state)
        if passed is None:
            raise IllegalTransitionError(f"goal {self.goal_id}", self.comm, state, tuple(row), ())
        self.is_acknowledged = True
        self.state, self.text = state, text
        return self._pass(passed, now)

    def not_listed(self, now: float) -> tuple[CommState, ...]:
        """Take a list without the goal: lost, unless the goal or its result may still be on the way."""
        if not self.is_acknowledged or self.comm in {CommState.WAITING_FOR_RESULT, CommState.DONE}:
            return ()
        return self._lose(_FORGOTTEN, now)

    def ended(self, state: GoalState, text: str, now: float) -> tuple[CommState, ...]:
        """Take the result's status."""
        if self.is_done:
            return ()
        passed = CLIENT_TRANSITIONS[self.comm].get(state, ())
        self.is_acknowledged = True
        self.state, self.text = state, text
        return self._pass((*passed, CommState.DONE), now)

    def cancelled(self, now: float) -> tuple[CommState, ...]:
        """Take note that a cancellation was sent; it changes nothing for a goal that ends already."""
        if self.comm in _ENDING:
            return ()
        self.sent_at = now
        return self._pass((CommState.WAITING_FOR_CANCEL_ACK,), now)

    def check(self, now: float, heard_at: float, silence_timeout: float) -> tuple[CommState, ...]:
        """Lose the goal if its server is silent, or if the result does not come.

        Args:
            now: The time.
            heard_at: When the server was heard last.
            silence_timeout: Seconds to wait.
        """
        if self.is_done:
            return ()
        if now - max(heard_at, self.since) > silence_timeout:
            return self._lose(_SILENT, now)
        if self.comm is CommState.WAITING_FOR_RESULT and now - self.since > silence_timeout:
            return self._lose(_NO_RESULT, now)
        return ()

    def must_repeat(self, now: float) -> bool:
        """Return whether goal or cancellation must be sent again; they then count as sent now."""
        waits = not self.is_acknowledged or self.comm is CommState.WAITING_FOR_CANCEL_ACK
        if self.is_done or not waits or now - self.sent_at < REPEAT_AFTER:
            return False
        self.sent_at = now
        return True

    def lose(self, text: str, now: float) -> tuple[CommState, ...]:
        """Give the goal up."""
        return () if self.is_done else self._lose(text, now)

    def _lose(self, text: str, now: float) -> tuple[CommState, ...]:
        self.state, self.text = GoalState.LOST, text
        return self._pass((CommState.DONE,), now)

    def _pass(self, states: tuple[CommState, ...], now: float) -> tuple[CommState, ...]:
        if states:
            self.comm, self.since = states[-1], now
        return states


class SilenceClock:
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
