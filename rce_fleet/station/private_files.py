"""Files of the station that only its owner reads, written whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path


def fleet_file(folder: Path, kind: str, fleet: str) -> Path:
    """Return a file of a fleet: several stations of a machine may share the folder.

    Args:
        folder: The folder.
        kind: What is in the file, one word.
        fleet: What tells the fleet from others.
    """
    return folder / f"{kind}-{hashlib.sha256(fleet.encode()).hexdigest()[:12]}.json"


def write_private(file: Path, body: bytes) -> None:
    """Write a file, and its folder if it is missing; after a crash it has the old or the new content. Blocks.

    Raises:
        OSError: It cannot be written.
    """
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as output:
            output.write(body)
            output.flush()
            os.fsync(output.fileno())
        aside.replace(file)
    finally:
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()
