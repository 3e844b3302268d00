"""The lock on a state folder: two masters on one folder would undo each other's work."""

from __future__ import annotations

import fcntl
import os
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreBusyError, StoreError

if TYPE_CHECKING:
    from pathlib import Path


UNFINISHED_RESTORE = "unfinished-restore"
"""Name of the file that is in a state folder while a state is restored to it."""


def check_restored(folder: Path) -> None:
    """Check that a state folder does not hold a part of a state.

    Raises:
        StoreError: A restore was interrupted.
    """
    if (folder / UNFINISHED_RESTORE).exists():
        raise StoreError(
            f"a restore to {folder} did not finish: repeat it with the same backup file (rce restore FILE"
            f" --replace); the state of before is in {folder}.before-DATE"
        )


class FolderLock:
    """Held while it is open; the kernel releases it when the process ends for any reason.

    Args:
        folder: Made if it is not there, readable by its owner only.
        restores: Whether it is held to restore the folder's contents.

    Raises:
        StoreBusyError: Another process holds it.
        StoreError: The folder cannot be used, or holds a part of a state because a restore did not finish.
    """

    def __init__(self, folder: Path, *, restores: bool = False) -> None:
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
        if not restores:
            try:
                check_restored(folder)
            except StoreError:
                self.close()
                raise

    def remove(self) -> None:
        """Remove its file, which is held until :meth:`close`."""
        self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Release it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
