"""The lock on a state folder: two masters on one folder would undo each other's work."""

from __future__ import annotations

import fcntl
import os
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreBusyError, StoreError

if TYPE_CHECKING:
    from pathlib import Path


class FolderLock:
    """Held while it is open; the kernel releases it when the process ends for any reason.

    Args:
        folder: Made if it is not there, readable by its owner only.

    Raises:
        StoreBusyError: Another process holds it.
        StoreError: The folder cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "lock"
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise StoreError(f"cannot use the state folder {folder}: {error}") from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._fd)
            self._fd = -1
            raise StoreBusyError(
                f"a master is running on the state folder {folder}; stop it first"
            ) from error

    def remove(self) -> None:
        """Remove its file, which is held until :meth:`close`."""
        self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Release it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
