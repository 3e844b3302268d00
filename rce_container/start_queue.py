"""The containers that wait to be started. Pure."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable

from rce.model import EndpointId


class StartQueue:
    """Containers that wait until fewer are starting, shared fairly between users.

    The next one is of the user with the fewest that are starting, and of several such users of the one whose
    last turn is longest ago. The containers of one user are started in their order.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[str]] = {}
        """Ids by user; users without any are left out."""
        self._turn = 0
        self._turns: dict[str, int] = {}
        """The number of the last turn of each user with containers that wait or are starting."""

    def put(self, id_: str) -> None:
        """Add a container."""
        self._waiting.setdefault(_user_of(id_), deque()).append(id_)

    def take(self, starting: Iterable[str]) -> str | None:
        """Remove and return the next container; None if none waits.

        Args:
            starting: The containers that are starting now.
        """
        busy = Counter(map(_user_of, starting))
        self._turns = {user: n for user, n in self._turns.items() if user in self._waiting or user in busy}
        if not self._waiting:
            return None
        user = min(self._waiting, key=lambda one: (busy[one], self._turns.get(one, 0)))
        self._turn += 1
        self._turns[user] = self._turn
        ids = self._waiting[user]
        id_ = ids.popleft()
        if not ids:
            del self._waiting[user]
        return id_

    def discard(self, is_unwanted: Callable[[str], bool]) -> list[str]:
        """Remove and return the containers for which ``is_unwanted`` is true."""
        unwanted = [id_ for ids in self._waiting.values() for id_ in ids if is_unwanted(id_)]
        if unwanted:
            waiting = [id_ for ids in self._waiting.values() for id_ in ids if not is_unwanted(id_)]
            self._waiting.clear()
            for id_ in waiting:
                self.put(id_)
        return unwanted


def _user_of(id_: str) -> str:
    return EndpointId.parse(id_).user
