"""Limits on the bytes that this process holds for the connections of each user and of all (sans-I/O).

Holders report when they hold more, not when they hold less. So before a holder must drop anything, the
relevant holders are asked again. Then the holder with the most drops its oldest data; one that cannot is
ended.
"""

from __future__ import annotations

import logging
from typing import Protocol

_log = logging.getLogger(__name__)
_MIB = 1 << 20


class Holder(Protocol):
    """An object that keeps bytes for a user: a robot."""

    @property
    def held(self) -> int:
        """Bytes that it holds now."""

    def shed(self, size: int) -> None:
        """Drop the oldest droppable data, ``size`` bytes if there are so many."""

    def fail(self, reason: str) -> None:
        """End, because its data may not be dropped; the reason is for its user."""


class Account:
    """The bytes of one holder, as far as the ledger knows."""

    __slots__ = ("_ledger", "held", "holder", "user")

    def __init__(self, ledger: Ledger, user: str, holder: Holder) -> None:
        self._ledger = ledger
        self.user = user
        self.holder = holder
        self.held = 0

    def note(self) -> None:
        """Take note that the holder holds more. May make it, or another one, shed or fail."""
        self._ledger._note(self)  # noqa: SLF001 - same module

    def close(self) -> None:
        """Take note that the holder is gone."""
        self._ledger._close(self)  # noqa: SLF001 - same module


class Ledger:
    """The accounts of all holders.

    Invariant: the sums are those of the accounts.

    Args:
        per_user: Bytes that the holders of one user may hold together.
        in_all: Bytes that all may hold together.

    Attributes:
        total: Bytes held.
        shed: How often a holder had to drop data.
        failed: How many holders were ended.
        growths: How often a holder reported that it holds more.
    """

    def __init__(self, *, per_user: int, in_all: int) -> None:
        self._per_user = per_user
        self._in_all = in_all
        self._accounts: dict[str, dict[Account, None]] = {}
        self._sums: dict[str, int] = {}
        self._settling = False
        self._complained: set[str] = set()
        """Users that were logged, for as long as they have an account."""
        self.total = 0
        self.shed = 0
        self.failed = 0
        self.growths = 0

    def open(self, user: str, holder: Holder) -> Account:
        """Make an account for a holder."""
        account = Account(self, user, holder)
        self._accounts.setdefault(user, {})[account] = None
        self._sums.setdefault(user, 0)
        return account

    def refresh(self) -> None:
        """Ask all holders for their bytes, so that the sums are right also where they became less."""
        for user in self._accounts:
            self._refresh(user)

    def held_by(self, user: str) -> int:
        """Return the bytes that a user's holders hold."""
        return self._sums.get(user, 0)

    def _note(self, account: Account) -> None:
        self.growths += 1
        self._check(account)
        if self._settling:
            return
        self._settling = True
        try:
            self._settle(account.user)
        finally:
            self._settling = False

    def _settle(self, user: str) -> None:
        if self.held_by(user) > self._per_user and self._refresh(user) > self._per_user:
            self._reduce(user, self._per_user, f"the robots of user {user}")
        if self.total > self._in_all:
            for one in list(self._accounts):
                self._refresh(one)
            while self.total > self._in_all:
                user = max(self._sums, key=lambda user: self._sums[user])
                self._reduce(user, self._sums[user] - (self.total - self._in_all), "all robots together")

    def _reduce(self, user: str, limit: int, who: str) -> None:
        """Bring a user below a limit."""
        while (excess := self._sums[user] - max(limit, 0)) > 0:
            if user not in self._complained:
                self._complained.add(user)
                _log.warning("user %s: %d MiB held, the oldest goes: %s", user, self._sums[user] // _MIB, who)
            account = max(self._accounts[user], key=lambda account: account.held)
            before = account.held
            account.holder.shed(min(excess, before))
            self._check(account)
            self.shed += 1
            if account.held >= before:
                self._end(account, f"{who} hold more memory of the engine than they may")

    def _end(self, account: Account, reason: str) -> None:
        self.failed += 1
        _log.warning("user %s: %d MiB held: %s", account.user, account.held // _MIB, reason)
        self._add(account, -account.held)
        account.holder.fail(reason)

    def _refresh(self, user: str) -> int:
        for account in self._accounts[user]:
            self._check(account)
        return self._sums[user]

    def _check(self, account: Account) -> None:
        if account in self._accounts.get(account.user, {}):
            self._add(account, account.holder.held - account.held)

    def _add(self, account: Account, change: int) -> None:
        account.held += change
        self._sums[account.user] += change
        self.total += change

    def _close(self, account: Account) -> None:
        accounts = self._accounts.get(account.user, {})
        if account in accounts:
            self._add(account, -account.held)
            del accounts[account]
            if not accounts:
                del self._accounts[account.user], self._sums[account.user]
                self._complained.discard(account.user)
