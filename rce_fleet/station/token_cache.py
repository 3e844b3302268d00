"""Which tokens were valid, and whose they are, as the engine said. Pure: the time is an argument.

Anybody can send tokens that are not valid. They have a memory of their own, so that they do not displace
those of users: these may stop robots also while the engine cannot be asked. Nor does a program that makes
tokens again and again displace those of others: the user who has most loses the oldest one.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.station.authentication import StationUser

MAX_CACHED = 1000
"""Tokens whose users are remembered, and as many that were not valid."""


class TokenCache:
    """The engine's last answers about tokens. Times are seconds of one clock that never goes back."""

    def __init__(self) -> None:
        self._valid: OrderedDict[str, tuple[float, StationUser]] = OrderedDict()
        self._refused: OrderedDict[str, float] = OrderedDict()

    def put(self, token: str, user: StationUser | None, now: float) -> None:
        """Take an answer of now; None: the token is not valid."""
        self.forget(token)
        if user is None:
            self._refused[token] = now
            if len(self._refused) > MAX_CACHED:
                self._refused.popitem(last=False)
            return
        self._valid[token] = now, user
        if len(self._valid) > MAX_CACHED:
            names = Counter(other.name for _, other in self._valid.values())
            most = max(names, key=lambda name: names[name])
            del self._valid[next(known for known, (_, other) in self._valid.items() if other.name == most)]

    def known(self, token: str, since: float) -> StationUser | None:
        """Return the user of a token that was valid at the last answer, if that came after a time."""
        asked_at, user = self._valid.get(token, (0.0, None))
        return user if user is not None and asked_at > since else None

    def is_refused(self, token: str, since: float) -> bool:
        """Return whether the last answer, if it came after a time, was that a token is not valid."""
        asked_at = self._refused.get(token)
        return asked_at is not None and asked_at > since

    def forget(self, token: str) -> None:
        """Forget what is known of a token."""
        self._valid.pop(token, None)
        self._refused.pop(token, None)
