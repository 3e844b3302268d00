"""The logs of containers, of those that live and, for a while, of those that ended.

``STATE/logs/USER/TAG/MARK`` holds the logs of one life of a container from its first moment on, so that
nothing has to be saved when it ends, however that happens. ``MARK.json`` beside it, out of the container's
reach, says when the life began and how it ended.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec import Struct

from rce.model.names import EndpointId
from rce_container.exceptions import StateError
from rce_container.logs import last_line
from rce_container.trees import remove, size_of
from rce_container.writing import write_whole

log = logging.getLogger(__name__)

LOG_DAYS = 3.0
LOG_SPACE = 1 << 30
MAX_LIVES = 20
"""How many ended lives of one container are kept at most."""
_DAY_S = 86400.0


class Life(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One life of a container, as its record says."""

    id: str
    mark: str
    began: float
    """Seconds since the epoch, as all times here."""
    ended: float = 0.0
    """0 as long as nobody saw it end."""
    reason: str = ""
    """Why it ended."""


class Kept(NamedTuple):
    """A life whose logs are there."""

    life: Life
    folder: Path


class LogArchive:
    """The logs of one container task set.

    Args:
        root: ``STATE/logs``.
        days: How long the logs of a life are kept after its end.
        space: How many bytes the logs of ended lives may take in all; the oldest go first.
    """

    def __init__(self, root: Path, *, days: float, space: int) -> None:
        self._root = root
        self._days = days
        self._space = space
        self._lock = threading.Lock()
        """Held while empty folders are removed or filled: lives are pruned in a thread of their own."""

    def begin(self, id_: str, mark: str, now: float) -> Path:
        """Make the folder for the logs of a new life.

        Raises:
            StateError: It cannot be made.
        """
        folder = self._folder(id_) / mark
        try:
            with self._lock:
                for path in (self._root, folder.parent.parent, folder.parent):
                    path.mkdir(mode=0o700, parents=True, exist_ok=True)
                _write(folder, Life(id=id_, mark=mark, began=now))
                folder.mkdir(mode=0o700)
        except OSError as error:
            self._remove(folder)
            raise StateError(f"cannot make {error.filename or folder}: {error.strerror}") from error
        return folder

    def end(self, id_: str, mark: str, reason: str, now: float) -> None:
        """Note how a life ended; done once, the first word counts."""
        folder = self._folder(id_) / mark
        life = _read(folder)
        if life is None or life.ended:
            return
        try:
            _write(folder, msgspec.structs.replace(life, ended=now, reason=reason))
        except OSError as error:
            log.warning("how container %s ended cannot be noted: %s", id_, error)

    def find(self, mark: str) -> Kept | None:
        """The life of a mark, whosever it is. Looks at every container; see :meth:`get`."""
        found = (_kept(folder / mark) for folder in self._tags())
        return next((kept for kept in found if kept is not None), None)

    def get(self, id_: str, mark: str) -> Kept | None:
        """The life of a mark, of a container."""
        return _kept(self._folder(id_) / mark)

    def folders(self) -> dict[str, Path]:
        """Where the logs of all lives are, by mark."""
        return {kept.life.mark: kept.folder for kept in self._all()}

    def ended(self, id_: str) -> list[Kept]:
        """The ended lives of a container, the newest first."""
        found = [kept for kept in self._lives(self._folder(id_)) if kept.life.ended]
        return sorted(found, key=_age)

    def settle(self, living: Collection[str], now: float) -> None:
        """Note the end of lives that nobody saw end.

        Args:
            living: The marks of lives of which something may be there.
            now: The time.
        """
        for kept in list(self._all()):
            if not kept.life.ended and kept.life.mark not in living:
                self._settle(kept, now)

    def settle_one(self, mark: str, now: float) -> None:
        """Note the end of a life that nobody saw end."""
        kept = self.find(mark)
        if kept is not None:
            self._settle(kept, now)

    def _settle(self, kept: Kept, now: float) -> None:
        words = last_line(kept.folder)
        reason = "no manager saw it end" + (f"; its last words: {words}" if words else "")
        self.end(kept.life.id, kept.life.mark, reason, now)

    def prune(self, now: float) -> None:
        """Remove what is too old or too much, the oldest first."""
        ended = sorted((kept for kept in self._all() if kept.life.ended), key=_age)
        space = self._space
        lives: dict[str, int] = {}
        for kept in ended:
            space -= size_of(kept.folder)
            lives[kept.life.id] = lives.get(kept.life.id, 0) + 1
            is_old = now - kept.life.ended > self._days * _DAY_S
            if is_old or space < 0 or lives[kept.life.id] > MAX_LIVES:
                self._remove(kept.folder)

    def _remove(self, folder: Path) -> None:
        remove(folder)
        with self._lock, contextlib.suppress(OSError):
            _record(folder).unlink()
            folder.parent.rmdir()
            folder.parent.parent.rmdir()

    def _folder(self, id_: str) -> Path:
        endpoint = EndpointId.parse(id_)
        return self._root / endpoint.user / endpoint.tag

    def _all(self) -> Iterator[Kept]:
        for folder in self._tags():
            yield from self._lives(folder)

    def _tags(self) -> Iterator[Path]:
        """The folders of all containers."""
        for user in _children(self._root):
            yield from _children(user)

    def _lives(self, folder: Path) -> Iterator[Kept]:
        """The lives of one container."""
        for path in _children(folder):
            if path.suffix == ".json" and (kept := _kept(path.with_suffix(""))) is not None:
                yield kept


def _children(folder: Path) -> list[Path]:
    """What is in a folder; nothing if it is gone: lives are pruned meanwhile."""
    try:
        return list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def _kept(folder: Path) -> Kept | None:
    life = _read(folder)
    return Kept(life, folder) if life is not None and life.mark == folder.name else None


def _age(kept: Kept) -> float:
    return -kept.life.ended


def _record(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.json")


def _read(folder: Path) -> Life | None:
    try:
        return msgspec.json.decode(_record(folder).read_bytes(), type=Life)
    except (OSError, msgspec.DecodeError):
        return None


def _write(folder: Path, life: Life) -> None:
    """Write a life's record, atomically."""
    write_whole(_record(folder), msgspec.json.encode(life))
