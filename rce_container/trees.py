"""Trees of files that nodes may have filled with whatever they like: measured and removed. All blocks."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from pathlib import Path


def size_of(folder: Path) -> int:
    """Tell how many bytes the files in a folder take; follows no links."""
    total = 0
    waiting = [str(folder)]
    while waiting:
        with contextlib.suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
    return total


def remove(folder: Path) -> None:
    """Remove a folder with all that is in it, as far as that is possible; may be repeated."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except RecursionError:  # rm goes as deep as it is
        rm = shutil.which("rm") or "/bin/rm"
        with contextlib.suppress(OSError):
            subprocess.run([rm, "-rf", "--", folder], check=False, capture_output=True)  # noqa: S603
