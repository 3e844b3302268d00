"""The folder of a demo run, and what runs that were killed left of theirs."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

PREFIX = "rce-demo-"
LOCK = "lock"
"""A file in the folder that its owner holds locked. The system unlocks it however the owner ends."""


@contextlib.contextmanager
def run_folder(keep_in: Path | None = None) -> Iterator[Path]:
    """Make a folder for this run.

    Args:
        keep_in: Where it is made, to be kept; if None, it is removed at the end, as are those that demos
            left which were killed.
    """
    if keep_in is not None:
        keep_in.mkdir(parents=True, exist_ok=True)
        stamp = time.strftime("demo-%Y%m%d-%H%M%S-")
        yield Path(tempfile.mkdtemp(prefix=stamp, dir=keep_in.absolute()))
        return
    remove_abandoned(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder


def remove_abandoned(parent: Path) -> list[Path]:
    """Remove folders of this user's demos that were killed; one whose programs still end is left alone.

    Returns:
        Those that were removed.
    """
    abandoned = [folder for folder in parent.glob(f"{PREFIX}*") if _is_abandoned(folder)]
    if not abandoned:
        return []
    lines = _command_lines()
    unused = [folder for folder in abandoned if not any(str(folder) in line for line in lines)]
    for folder in unused:
        shutil.rmtree(folder, ignore_errors=True)
    return unused


def _is_abandoned(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            return False
        with (folder / LOCK).open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    return False  # somebody holds it, or it is none of ours


def _command_lines() -> list[str]:
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            found.append(" ".join(process.cmdline()))
    return found
