"""Folders of tests in /tmp, where paths of sockets stay below the kernel's 107 bytes."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from pathlib import Path

TMP = Path("/tmp")
PREFIX = "rce-t-"
RUN_PREFIX = "rce-run-"
OLD_S = 24 * 3600.0


def make_folder() -> Path:
    """Make a folder with a short path."""
    return Path(tempfile.mkdtemp(prefix=PREFIX, dir=TMP))


def sweep_old_folders(parent: Path = TMP) -> None:
    """Remove what killed or failed runs left a day ago or earlier: each may be some gigabytes.

    Folders of other users stay, and those in which something is mounted.
    """
    mounts = [line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines()]
    for prefix in (PREFIX, RUN_PREFIX):
        for folder in parent.glob(f"{prefix}*"):
            with contextlib.suppress(FileNotFoundError):  # a run beside this one has removed it
                known = folder.stat()
                is_old = time.time() - known.st_mtime > OLD_S
                if is_old and known.st_uid == os.geteuid() and not any(_holds(folder, at) for at in mounts):
                    shutil.rmtree(folder, ignore_errors=True)


def _holds(folder: Path, place: str) -> bool:
    return place == str(folder) or place.startswith(f"{folder}/")
