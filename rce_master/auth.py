"""Checks passwords."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import secrets
import time
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError
from argon2.low_level import ARGON2_VERSION

from rce.guard import CrowdedError, Turns
from rce_master.exceptions import TooManyFailuresError, TooManyLoginsError, WrongCredentialsError
from rce_master.lottery import Lottery
from rce_master.state.user_records import KnownLogin, User
from rce_master.throttle import AGAIN_S, MAX_DELAY_S, FailureThrottle, pair_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from rce_master.state.tables import Tables

T = TypeVar("T")

HASH_WORKERS = 2
"""Concurrent checks; argon2 takes much memory and time by design, so more would only help an attacker."""
MAX_WAITING = 64
"""Unknown passwords that wait to be hashed; beyond it, the address with the most must try later."""
MAX_JOINED = 32
"""Logins with the same password that may wait for a delayed check."""


def client_digest(password: str) -> str:
    """The SHA-256 of a password in hex, which clients send in its place."""
    return hashlib.sha256(password.encode("utf-8", "surrogatepass")).hexdigest()


def hash_public(digest: str) -> str:
    """Hash a password that all know, such as that of development mode; neither it nor its checks take long.

    Args:
        digest: SHA-256 of the password in hex.
    """
    return PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash(digest)


@dataclass(eq=False, slots=True)
class _Check:
    """A password that is being checked; concurrent logins with the same password wait for the same check."""

    name: str
    stored: str
    digest: str
    address: str
    pair: str
    delay: float
    """Seconds to wait because of the address."""
    has_turn: bool
    """Whether it need not wait for a turn of its address and user."""
    joined: int = 0
    result: asyncio.Task[bool | TooManyFailuresError | TooManyLoginsError] = field(init=False)

    @property
    def is_put_off(self) -> bool:
        return self.delay > 0 or not self.has_turn


class Authenticator:
    """Checks passwords against the state's users.

    A correct password is recognized later by a keyed mark of it, so that a whole fleet that reconnects at
    once costs one argon2 and not hundreds, and attackers who guess do not slow it down. Marks are kept in the
    store, across restarts. The key is not: a copy of the store alone does not make guessing faster than
    argon2 allows.

    Unknown passwords are checked in turns by address, and there by user, and delayed where they fail often
    (:mod:`rce_master.throttle`): the first login of a user waits for one check of each other user whose
    password is guessed from the same address, regardless of the number of connections, and draws lots with
    guesses at its own user from there. A password that is set while the master runs is known at once.

    Args:
        tables: The state's tables, to read users and marks from.
        hasher: How passwords are hashed.
        clock: Seconds that never go back.
        keys: Returns the keys of the marks, the current one first; marks of a key that it returns no more
            are invalid. None: a random one.
        remember: Stores a user's mark; without it marks are not stored.
    """

    def __init__(
        self,
        tables: Tables,
        *,
        hasher: PasswordHasher | None = None,
        clock: Callable[[], float] = time.monotonic,
        keys: Callable[[], Sequence[bytes]] | None = None,
        remember: Callable[[KnownLogin], Awaitable[object]] | None = None,
    ) -> None:
        self._tables = tables
        self._hasher = hasher or PasswordHasher()
        self._clock = clock
        own = (secrets.token_bytes(32),)
        self._keys: Callable[[], Sequence[bytes]] = (lambda: own) if keys is None else keys
        self._remember = remember
        self._known: dict[str, str] = {}
        """Marks by user, of this run; the tables have those of earlier runs."""
        self._throttle = FailureThrottle()
        self._lottery = Lottery(lambda pair: self._throttle.take(pair, self._clock()))
        self._workers = ThreadPoolExecutor(HASH_WORKERS, thread_name_prefix="argon2")
        self._turns = Turns(HASH_WORKERS, waiting=MAX_WAITING)
        self._checks: dict[str, _Check] = {}
        self.checks = 0
        """Passwords that were hashed to check them."""
        # Checked for unknown users, so that the time does not reveal which users exist.
        self._unknown_user = _random_hash(self._hasher)

    async def verify(self, name: str, digest: str, address: str = "") -> User:
        """Check a password.

        Args:
            name: The user's name.
            digest: SHA-256 of the password in hex, as clients send it.
            address: Where it comes from.

        Raises:
            WrongCredentialsError: The user is unknown or the password is wrong.
            TooManyFailuresError: Too many passwords from this address were wrong recently.
            TooManyLoginsError: Too many passwords wait to be checked.
        """
        user = self._tables.users.get(name)
        stored = user.password if user else self._unknown_user
        mark, *former = self._marks(name, stored, digest)
        if any(self._is_known(name, one) for one in former):
            await self._know(name, mark)  # before the former secret is retired
        elif not self._is_known(name, mark):
            right = await self._check(name, stored, digest, mark, address)
            if not right or user is None:
                raise WrongCredentialsError("unknown user or wrong password")
            await self._know(name, mark)
        if user is None or self._tables.users.get(name) != user:
            raise WrongCredentialsError("unknown user or wrong password")
        return user

    async def hash(self, digest: str, asker: str = "") -> str:
        """Hash a password's digest for the store.

        Args:
            digest: SHA-256 of the password in hex.
            asker: The user on whose behalf it is done.

        Raises:
            TooManyLoginsError: Too many logins wait for the same check.
        """
        try:
            async with self._turns.turn("", asker):
                return await self._in_worker(self._hasher.hash, digest)
        except CrowdedError:
            raise TooManyLoginsError from None

    async def know(self, name: str, stored: str, digest: str) -> None:
        """Recognize a password that was just set: its first use is not queued.

        Args:
            name: The user's name.
            stored: The result of :meth:`hash` for it.
            digest: SHA-256 of the password in hex.
        """
        await self._know(name, self._marks(name, stored, digest)[0])

    def close(self) -> None:
        """Stop the worker threads."""
        for check in self._checks.values():
            check.result.cancel()
        self._workers.shutdown()

    async def _check(self, name: str, stored: str, digest: str, mark: str, address: str) -> bool:
        """Check an unknown password, or wait for a running check of the same one."""
        while True:
            check = self._checks.get(mark)
            if check is None:
                check = self._begin(name, stored, digest, mark, address)
            elif check.is_put_off and check.joined >= MAX_JOINED:
                raise TooManyFailuresError(MAX_DELAY_S)
            own = not check.joined
            check.joined += 1
            # Not cancelled with the login that began it: other logins may wait for it.
            outcome = await asyncio.shield(check.result)
            if isinstance(outcome, bool):
                return outcome
            if isinstance(outcome, TooManyFailuresError):
                raise TooManyFailuresError(outcome.retry_after)
            if own:
                raise outcome

    def _begin(self, name: str, stored: str, digest: str, mark: str, address: str) -> _Check:
        pair = pair_of(address, name)
        if self._throttle.is_crowded(pair):
            raise TooManyFailuresError(AGAIN_S)
        has_turn = self._lottery.take(pair)
        delay = self._throttle.admit(address, self._clock()) if has_turn else 0.0
        check = _Check(name, stored, digest, address, pair, delay, has_turn)
        self._checks[mark] = check
        check.result = asyncio.get_running_loop().create_task(self._look(check))
        check.result.add_done_callback(lambda _: self._checks.pop(mark))
        return check

    async def _look(self, check: _Check) -> bool | TooManyFailuresError | TooManyLoginsError:
        if check.is_put_off and not await self._wait(check):
            return TooManyFailuresError(AGAIN_S)
        # Unknown names share one turn: invented names do not give more turns.
        member = check.name if check.name in self._tables.users else ""
        try:
            async with self._turns.turn(check.address, member):
                self.checks += 1
                right = await self._in_worker(self._compare, check.stored, check.digest)
        except CrowdedError:
            self._throttle.passed(check.address, check.pair, self._clock())
            return TooManyLoginsError()
        if right:
            self._throttle.passed(check.address, check.pair, self._clock())
        return right

    async def _wait(self, check: _Check) -> bool:
        """Wait for a turn, and because of the address; return whether the check may be made."""
        began = self._clock()
        with self._throttle.delaying(check.pair):
            if not check.has_turn:
                # Logins with the same password, as those of a fleet, have a ticket each.
                if not await self._lottery.draw(check.pair, lambda: check.joined, MAX_DELAY_S):
                    return False
                check.delay = self._throttle.admit(check.address, self._clock())
            left = MAX_DELAY_S - (self._clock() - began)
            await asyncio.sleep(max(0.0, min(check.delay, left)))
        return True

    async def _in_worker(self, work: Callable[..., T], *args: str) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._workers, work, *args)

    def _compare(self, stored: str, digest: str) -> bool:
        try:
            return self._hasher.verify(stored, digest)
        except (VerificationError, InvalidHashError):
            return False

    def _marks(self, name: str, stored: str, digest: str) -> list[str]:
        """Return the marks of a password with all keys, the current one first."""
        # The stored hash is part of it: a changed password invalidates old marks.
        text = f"{name}\0{stored}\0{digest}".encode("utf-8", "surrogatepass")
        return [hashlib.blake2b(text, key=key, digest_size=32).hexdigest() for key in self._keys()]

    def _is_known(self, name: str, mark: str) -> bool:
        kept = self._tables.known_logins.get(name)
        known = (self._known.get(name, ""), "" if kept is None else kept.mark)
        return any(hmac.compare_digest(mark, one) for one in known)

    async def _know(self, name: str, mark: str) -> None:
        if self._known.get(name) == mark:
            return
        self._known[name] = mark
        if self._remember is not None:
            try:
                await self._remember(KnownLogin(user=name, mark=mark))
            except BaseException:
                self._known.pop(name, None)  # so that the next login stores it
                raise


def _random_hash(hasher: PasswordHasher) -> str:
    """Return what looks like the hash of a password; a check of it takes as long as any other, and fails.

    To hash a random one would hold up the event loop of a master that takes over and has to renew its lease.
    """
    salt, digest = (
        b64encode(secrets.token_bytes(size)).rstrip(b"=").decode()
        for size in (hasher.salt_len, hasher.hash_len)
    )
    costs = f"m={hasher.memory_cost},t={hasher.time_cost},p={hasher.parallelism}"
    return f"$argon2{hasher.type.name.lower()}$v={ARGON2_VERSION}${costs}${salt}${digest}"
