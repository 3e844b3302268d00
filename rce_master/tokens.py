"""Bearer tokens: made, recognised, and when each was last used."""

from __future__ import annotations

import asyncio
import hashlib
import secrets
import time
from typing import TYPE_CHECKING, Protocol

from rce_master.exceptions import WrongCredentialsError
from rce_master.state import commands
from rce_master.state.user_records import Token, User

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce_master.state.tables import Tables

TOKEN_LIFETIME_S = 30 * 24 * 3600.0
TOKEN_PREFIX = "rce_"  # noqa: S105 - the visible start of every token, not a secret
NOTE_EVERY_S = 60.0
"""How often the times of last use go to the store: they are exact to this."""


def token_digest(token: str) -> str:
    """Return what is kept of a bearer token. It is random, so a plain hash is enough."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()


def new_token(
    user: str, label: str, now: float, lifetime: float = TOKEN_LIFETIME_S, *, scope: str = ""
) -> tuple[str, Token]:
    """Make a bearer token.

    Args:
        user: Whose it is.
        label: What its owner calls it.
        now: Seconds since 1970.
        lifetime: Seconds for which it is good; 0: until it is revoked.
        scope: What it is good for, see :attr:`rce_master.state.user_records.Token.scope`.

    Returns:
        The token, which only its owner gets, and what is kept of it.
    """
    token = TOKEN_PREFIX + secrets.token_urlsafe(32)
    expires = now + lifetime if lifetime else 0.0
    record = Token(
        digest=token_digest(token), user=user, label=label, created=now, expires=expires, scope=scope
    )
    return token, record


class _Submits(Protocol):
    """Carries out commands: :class:`rce_master.state_service.StateService`."""

    async def submit_all(self, commands: Sequence[commands.Command]) -> object:
        """Do commands."""


class Tokens:
    """Recognises tokens, and remembers when each was last used.

    The times of use are kept in memory and go to the store once a minute, so that a request costs no write.

    Args:
        tables: The state's tables, to read tokens and users from.
        clock: Seconds since 1970.
    """

    def __init__(self, tables: Tables, clock: Callable[[], float] = time.time) -> None:
        self._tables = tables
        self._clock = clock
        self._used: dict[str, float] = {}

    def find(self, token: str) -> tuple[User, Token]:
        """Return whose token it is, and what is kept of it.

        Raises:
            WrongCredentialsError: It is unknown, expired or was revoked.
        """
        now = self._clock()
        record = self._tables.tokens.get(token_digest(token))
        user = self._tables.users.get(record.user) if record else None
        if record is None or user is None or record.is_expired(now):
            raise WrongCredentialsError("unknown or expired token; log in again")
        self._used[record.digest] = now
        return user, record

    def last_use(self, token: Token) -> float:
        """Return when a token was last used, in seconds since 1970; 0: never."""
        return self._used.get(token.digest, token.used)

    def uses(self) -> commands.NoteTokenUses:
        """Return the uses that the state does not know yet; they count as noted."""
        used, self._used = self._used, {}
        return commands.NoteTokenUses(used=used)

    def uses_of(self, user: str) -> commands.NoteTokenUses:
        """Do what :meth:`uses` does, for the tokens of one user."""
        digests = [token.digest for token in self._tables.tokens.by("user", user)]
        used = {digest: self._used.pop(digest) for digest in digests if digest in self._used}
        return commands.NoteTokenUses(used=used)

    async def run(self, state_service: _Submits) -> None:
        """Note the uses again and again, until cancelled."""
        while True:
            await asyncio.sleep(NOTE_EVERY_S)
            if self._used:
                await state_service.submit_all([self.uses()])
