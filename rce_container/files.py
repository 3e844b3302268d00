"""Files of containers: written whole or not at all; what nodes left is measured and removed. All blocks."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, by way of ``NAME.new`` beside it.

    Args:
        path: The file.
        data: All of it.

    Raises:
        OSError: It cannot be written; names a file. What was there before still is.
    """
    temporary = path.with_name(f"{path.name}.new")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        error.filename = error.filename or str(path)
        raise


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
