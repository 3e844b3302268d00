"""Who may come in: passwords."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import secrets
import time
from collections import Counter, OrderedDict, deque
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from rce_master.exceptions import TooManyFailures, TooManyLogins, WrongCredentials

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rce_master.state.records import User
    from rce_master.state.tables import Tables

MAX_FAILURES = 10
FAILURE_WINDOW_S = 60.0
CACHE_SIZE = 4096
HASH_WORKERS = 2
"""argon2 takes much memory and time on purpose; more at once would help an attacker only."""
MAX_WAITING = 64
"""Unknown passwords that wait to be hashed; what comes then is told to try later, and holds nobody up."""


def client_digest(password: str) -> str:
    """What a client sends instead of a password: its SHA-256 in hex."""
    return hashlib.sha256(password.encode()).hexdigest()


class Authenticator:
    """Checks passwords against the state's users.

    A password that was right once is known again by a keyed hash in memory, so that a whole fleet that
    reconnects at once costs one argon2 and not hundreds. Wrong ones are counted for each user: beyond a
    limit only a password that is known to be right is accepted for a while.

    Args:
        tables: The state's tables, to read users from.
        hasher: How passwords are hashed.
        clock: Seconds that never go back.
    """

    def __init__(
        self,
        tables: Tables,
        *,
        hasher: PasswordHasher | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tables = tables
        self._hasher = hasher or PasswordHasher()
        self._clock = clock
        self._key = secrets.token_bytes(32)
        self._known: OrderedDict[bytes, None] = OrderedDict()
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()
        self._workers = ThreadPoolExecutor(HASH_WORKERS, thread_name_prefix="argon2")
        self._slots = asyncio.Semaphore(HASH_WORKERS)
        self._waiting: Counter[bytes] = Counter()
        # Checked for unknown users, so that the time it takes does not tell who exists.
        self._nobody = self._hasher.hash(secrets.token_hex())

    async def verify(self, name: str, digest: str) -> User:
        """Check a password.

        Args:
            name: The user's name.
            digest: SHA-256 of the password in hex, as clients send it.

        Raises:
            WrongCredentials: The user is unknown or the password wrong.
            TooManyFailures: It was wrong too often lately.
            TooManyLogins: Too many wait to be checked.
        """
        user = self._tables.users.get(name)
        stored = user.password if user else self._nobody
        mark = self._mark(name, stored, digest)
        if not self._is_known(mark):
            self._check_failures(name)
            async with self._turn(mark):
                right = self._is_known(mark)
                if not right:  # nor did somebody who waited before us find out that it is
                    self._check_failures(name)
                    right = await self._matches(stored, digest)
            if not right or user is None:
                self._note_failure(name)
                raise WrongCredentials("unknown user or wrong password")
            self._know(mark)
        if user is None or self._tables.users.get(name) != user:
            raise WrongCredentials("unknown user or wrong password")
        return user

    async def hash(self, digest: str) -> str:
        """Hash a password's digest for the store.

        Raises:
            TooManyLogins: Too many wait for the same.
        """
        async with self._turn(secrets.token_bytes(8)):
            return await asyncio.get_running_loop().run_in_executor(self._workers, self._hasher.hash, digest)

    def close(self) -> None:
        """Stop the worker threads."""
        self._workers.shutdown()

    @contextlib.asynccontextmanager
    async def _turn(self, mark: bytes) -> AsyncIterator[None]:
        """Wait for a worker thread, unless too many others wait; those who wait for the same are one."""
        if mark not in self._waiting and len(self._waiting) >= MAX_WAITING:
            raise TooManyLogins
        self._waiting[mark] += 1
        try:
            async with self._slots:
                yield
        finally:
            self._waiting[mark] -= 1
            if not self._waiting[mark]:
                del self._waiting[mark]

    async def _matches(self, stored: str, digest: str) -> bool:
        return await asyncio.get_running_loop().run_in_executor(self._workers, self._compare, stored, digest)

    def _compare(self, stored: str, digest: str) -> bool:
        try:
            return self._hasher.verify(stored, digest)
        except (VerificationError, InvalidHashError):
            return False

    def _mark(self, name: str, stored: str, digest: str) -> bytes:
        # The stored hash is part of it: a changed password makes old marks worthless.
        text = f"{name}\0{stored}\0{digest}".encode()
        return hashlib.blake2b(text, key=self._key, digest_size=32).digest()

    def _is_known(self, mark: bytes) -> bool:
        if mark not in self._known:
            return False
        self._known.move_to_end(mark)
        return True

    def _know(self, mark: bytes) -> None:
        self._known[mark] = None
        if len(self._known) > CACHE_SIZE:
            self._known.popitem(last=False)

    def _check_failures(self, name: str) -> None:
        failures = self._failures.get(name)
        if failures is None or len(failures) < MAX_FAILURES:
            return
        wait = failures[0] + FAILURE_WINDOW_S - self._clock()
        if wait > 0:
            raise TooManyFailures(wait)

    def _note_failure(self, name: str) -> None:
        failures = self._failures.setdefault(name, deque(maxlen=MAX_FAILURES))
        failures.append(self._clock())
        self._failures.move_to_end(name)
        if len(self._failures) > CACHE_SIZE:
            self._failures.popitem(last=False)
