"""Who uses a station, and what they may do there (pure)."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import Protocol

from rce_client.exceptions import ClientError

_SEES = frozenset({"viewer", "operator", "admin"})
_STEERS = frozenset({"operator", "admin"})


class EntranceError(ClientError):
    """Nobody can be let in now, or not this one.

    Attributes:
        status: The HTTP status that tells the same.
        retry_after: Seconds after which to try again; 0 if nothing was said.
    """

    def __init__(self, status: int, text: str, retry_after: int = 0) -> None:
        self.status = status
        self.retry_after = retry_after
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody at a station.

    Attributes:
        name: Name of the engine's user.
        role: The user's role at the engine.
        owns: Whether the fleet is this user's own.
    """

    name: str
    role: str
    owns: bool = False

    @property
    def sees(self) -> bool:
        """Whether the fleet may be looked at."""
        return self.owns or self.role in _SEES

    @property
    def steers(self) -> bool:
        """Whether robots may be sent and cells blocked."""
        return (self.owns and self.role != "viewer") or self.role in _STEERS


@dataclass(frozen=True, slots=True)
class Action:
    """What somebody did at a station, for the engine's audit log."""

    name: str
    subject: str
    detail: str
    address: str
    done: bool = True


class Entrance(Protocol):
    """Says who somebody is."""

    @property
    def has_logins(self) -> bool:
        """Whether people log in here by name and password."""

    async def who(self, token: str) -> Person | None:
        """Return whose token it is; None: nobody may come in by it.

        Raises:
            EntranceError: It cannot be found out now.
        """

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Return a token for a user.

        Raises:
            EntranceError: The password is wrong, or it cannot be found out now.
        """

    async def log_out(self, token: str) -> None:
        """Make a token worthless."""

    def note(self, token: str, action: Action) -> None:
        """Have an action written down; never waits."""


class SharedToken:
    """One token for all, or none: for a fleet without an engine, which has no users.

    Args:
        token: What callers must show; empty: anybody may come in.
    """

    has_logins = False

    def __init__(self, token: str = "") -> None:
        self._token = token.encode()

    async def who(self, token: str) -> Person | None:
        """Return the operator, who has no name."""
        fits = not self._token or hmac.compare_digest(token.encode(errors="surrogateescape"), self._token)
        return Person("operator", "operator") if fits else None

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Refuse: there are no users.

        Raises:
            EntranceError: Always.
        """
        del user, password, address
        raise EntranceError(404, "this station has no users; callers show its token")

    async def log_out(self, token: str) -> None:
        """Do nothing: the token is good until the station ends."""

    def note(self, token: str, action: Action) -> None:
        """Do nothing: there is no engine that keeps an audit log."""
