"""User ids of the machine without an owner, one for each container."""

from __future__ import annotations

import fcntl
import os
import pwd
from pathlib import Path

from rce_container.exceptions import StartError

FIRST_UID = 700_000
UIDS = 10_000
"""The users for containers, unless others are set."""

SUBUIDS = Path("/etc/subuid")
"""The subordinate user ids of the machine's users: name, first id, count."""
_COLONS = 2

LOCKS = Path("/run/rce/uids")
"""One lock file for each user id that was allocated, for all engines of the machine."""


class UidPool:
    """Allocates users. One stays allocated while a descriptor of its lock is open in any process.

    So it stays allocated when the manager ends and its containers run, and is free when the last process that
    inherited the lock has ended for any reason.

    Args:
        first: The first user, and group.
        count: How many there are.
        folder: Where the locks are; one for the whole machine.
    """

    def __init__(self, first: int, count: int, folder: Path = LOCKS) -> None:
        self._first = first
        self._count = count
        self._folder = folder
        self._next = 0

    def owners(self, subuids: Path = SUBUIDS) -> list[str]:
        """Return the names of users who own some of these user ids, from the machine's files."""
        end = self._first + self._count
        found = [entry.pw_name for entry in pwd.getpwall() if self._first <= entry.pw_uid < end]
        try:
            lines = subuids.read_text().splitlines()
        except OSError:
            lines = []
        for name, first, count in (line.split(":") for line in lines if line.count(":") == _COLONS):
            if (
                first.isdigit()
                and count.isdigit()
                and int(first) < end
                and int(first) + int(count) > self._first
            ):
                found.append(name)
        return sorted(set(found))

    def take(self) -> tuple[int, int]:
        """Allocate a user.

        Returns:
            The user and a descriptor of its lock, for the container's processes to inherit.

        Raises:
            StartError: All are allocated, or the locks cannot be used.
        """
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            for _ in range(self._count):
                uid = self._first + self._next
                self._next = (self._next + 1) % self._count
                lock = self._open(uid)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    os.close(lock)
                else:
                    return uid, lock
        except OSError as error:
            raise StartError(f"cannot give out users by locks in {self._folder}: {error}") from error
        raise StartError(
            f"all {self._count} users from {self._first} on belong to containers; allow more of them"
        )

    def _open(self, uid: int) -> int:
        """Open a lock, as descriptor 10 or higher: shells use lower numbers themselves."""
        lock = os.open(self._folder / str(uid), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            return fcntl.fcntl(lock, fcntl.F_DUPFD_CLOEXEC, 10)
        finally:
            os.close(lock)
