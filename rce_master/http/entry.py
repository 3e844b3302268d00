"""``GET /``: the entry point of clients of the robot protocol."""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING

from rce.protocol import HandshakeError, master_reply, read_master_request
from rce.web.entry import EntryAnswer
from rce_master.reconciler import SILENT_S
from rce_master.state import robots

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce_master.state.records import TaskSet
    from rce_master.state.tables import Tables

EXPECTED_S = 5.0
"""How long a redirected robot counts at its task set before it has logged in."""


MAX_EXPECTED = 10_000
"""Maximum number of expected robots: the entry is public, and a client need not connect afterwards."""


class Entry:
    """Hands out the least loaded robot task set.

    Clients that were just sent to one and have not logged in yet count as its load; else a fleet that
    connects at once would go to the same one.

    Args:
        tables: The state's tables.
        clock: Seconds that never go back.
        silence: Tells for how many seconds a task set, by its name, gave no sign of life.
    """

    def __init__(
        self, tables: Tables, clock: Callable[[], float], silence: Callable[[str], float] = lambda _: 0.0
    ) -> None:
        self._tables = tables
        self._clock = clock
        self._silence = silence
        self._sent: deque[tuple[float, str]] = deque()
        self._expected: Counter[str] = Counter()

    def answer(self, query: str) -> EntryAnswer:
        """Answer a client with its WebSocket URL.

        Args:
            query: What comes after the ``?``, still percent-encoded.
        """
        try:
            wanted = read_master_request(query)
        except HandshakeError as error:
            return _plain(error.status, f"{error.reason}\n")
        task_set = self.choose()
        if task_set is None:
            return refusal("No robot process is free; try again later.\n")
        body = master_reply(wanted, task_set.url, header=task_set.bearer)
        return EntryAnswer(200, body, "application/json; charset=utf-8")

    def choose(self) -> TaskSet | None:
        """Choose the least loaded robot task set, and expect a robot there."""
        now = self._clock()
        while self._sent and (self._sent[0][0] <= now - EXPECTED_S or len(self._sent) >= MAX_EXPECTED):
            self._expected[self._sent.popleft()[1]] -= 1
        there = [one for one in robots.open_task_sets(self._tables) if one.url]
        heard = [one for one in there if self._silence(one.process) < SILENT_S]
        chosen = min(
            heard or there, key=lambda s: (self._load(s) + self._expected[s.process], s.process), default=None
        )
        if chosen is not None:
            self._sent.append((now, chosen.process))
            self._expected[chosen.process] += 1
        return chosen

    def _load(self, task_set: TaskSet) -> int:
        return self._tables.endpoints.count("task_set", task_set.process)


def refusal(text: str) -> EntryAnswer:
    """Return an answer to a client that may ask again, or another master."""
    return _plain(503, text, {"Retry-After": "1"})


def _plain(status: int, text: str, headers: Mapping[str, str] | None = None) -> EntryAnswer:
    return EntryAnswer(status, text.encode(), "text/plain; charset=utf-8", headers or {})
