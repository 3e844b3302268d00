"""Writing files so that neither a full disk nor a crash leaves half of one."""

from __future__ import annotations

import contextlib
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
