"""Files of the station that only its owner reads, written whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

T = TypeVar("T")


def fleet_file(folder: Path, kind: str, fleet: str, ending: str = "json") -> Path:
    """Return a file of a fleet: several stations of a machine may share the folder.

    Args:
        folder: The folder.
        kind: What is in the file, one word.
        fleet: What tells the fleet from others.
        ending: Of the file's name.
    """
    return folder / f"{kind}-{hashlib.sha256(fleet.encode()).hexdigest()[:12]}.{ending}"


def make_private(file: Path) -> None:
    """Make an empty file, and its folder, where they are missing. Blocks.

    Raises:
        OSError: They cannot be made.
    """
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.close(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600))


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


class KeptInFile(Generic[T]):
    """What is kept in a private file, as JSON.

    Args:
        content_type: Type of the content.
        content: The content if there is no file.
        file: Where it is kept; None: in memory only.
    """

    def __init__(self, content_type: type[T], content: T, file: Path | None = None) -> None:
        self._content_type = content_type
        self._content = content
        self._file = file
        self._saving = threading.Lock()
        """A save goes on in its thread when the task that waits for it is cancelled."""
        self._revision = self._written = 0
        """Of the content; to be increased with each change."""

    @property
    def is_saved(self) -> bool:
        """Whether the file has the newest content."""
        return self._file is None or self._written == self._revision

    def load(self) -> None:
        """Read the file; a missing one changes nothing. Blocks.

        Raises:
            OSError: It cannot be read.
            msgspec.MsgspecError: It is damaged.
        """
        if self._file is not None and self._file.exists():
            self._content = msgspec.json.decode(self._file.read_bytes(), type=self._content_type)

    def save(self) -> None:
        """Write the file, whole or not at all; nothing if it has the newest content. Blocks.

        Raises:
            OSError: It cannot be written.
        """
        if self._file is None:
            return
        with self._saving:
            if self._written != self._revision:
                revision = self._revision
                write_private(self._file, msgspec.json.encode(self._content))
                self._written = revision
