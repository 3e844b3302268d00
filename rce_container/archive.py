"""The logs of running containers and, for a limited time, of ended ones.

``STATE/logs/USER/TAG/MARK`` holds the logs of one incarnation of a container from its start, so the logs are
complete however the incarnation ends. ``MARK.json`` beside it, which the container cannot reach, records when
the incarnation began and how it ended.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec import Struct, field

from rce.model import EndpointId
from rce_container.exceptions import StateError
from rce_container.files import UNFINISHED, remove, size_of, write_whole
from rce_container.logs import last_line

_log = logging.getLogger(__name__)

LOG_DAYS = 3.0
LOG_SPACE = 1 << 30
MAX_INCARNATIONS = 20
"""How many ended incarnations of one container are kept at most."""
_DAY_S = 86400.0


class IncarnationRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One incarnation of a container, as its record says."""

    id: str
    incarnation_id: str = field(name="mark")
    began: float
    """Seconds since the epoch, as all times here."""
    ended: float = 0.0
    """0 as long as its end is not known."""
    reason: str = ""
    """Why it ended."""


class Kept(NamedTuple):
    """An incarnation whose logs are kept."""

    record: IncarnationRecord
    folder: Path


class LogArchive:
    """The logs of one container task set.

    Args:
        root: ``STATE/logs``.
        days: How long the logs of an incarnation are kept after its end.
        space: How many bytes the logs of ended incarnations may take in all; the oldest go first.
    """

    def __init__(self, root: Path, *, days: float, space: int) -> None:
        self._root = root
        self._days = days
        self._space = space
        self._lock = threading.Lock()
        """Held while empty folders are removed or filled: pruning runs in a separate thread."""

    def begin(self, id_: str, incarnation_id: str, now: float) -> Path:
        """Make the folder for the logs of a new incarnation.

        Raises:
            StateError: It cannot be made.
        """
        folder = self._folder(id_) / incarnation_id
        try:
            with self._lock:
                for path in (self._root, folder.parent.parent, folder.parent):
                    path.mkdir(mode=0o700, parents=True, exist_ok=True)
                _write(folder, IncarnationRecord(id=id_, incarnation_id=incarnation_id, began=now))
                folder.mkdir(mode=0o700)
        except OSError as error:
            self._remove(folder)
            raise StateError(f"cannot make {error.filename or folder}: {error.strerror}") from error
        return folder

    def end(self, id_: str, incarnation_id: str, reason: str, now: float) -> None:
        """Record how an incarnation ended. Only the first call has an effect."""
        folder = self._folder(id_) / incarnation_id
        record = _read(folder)
        if record is None or record.ended:
            return
        try:
            _write(folder, msgspec.structs.replace(record, ended=now, reason=reason))
        except OSError as error:
            _log.warning("how container %s ended cannot be noted: %s", id_, error)

    def find(self, incarnation_id: str) -> Kept | None:
        """Return the incarnation with an id, of any user. Searches every container; see :meth:`get`."""
        found = (_kept(folder / incarnation_id) for folder in self._tags())
        return next((kept for kept in found if kept is not None), None)

    def get(self, id_: str, incarnation_id: str) -> Kept | None:
        """Return the incarnation of a container by id."""
        return _kept(self._folder(id_) / incarnation_id)

    def folders(self) -> dict[str, Path]:
        """Return the log folders of all incarnations, by id."""
        return {kept.record.incarnation_id: kept.folder for kept in self._all()}

    def ended(self, id_: str) -> list[Kept]:
        """Return the ended incarnations of a container, the newest first."""
        found = [kept for kept in self._incarnations(self._folder(id_)) if kept.record.ended]
        return sorted(found, key=_age)

    def settle(self, living: Collection[str], now: float) -> None:
        """Record the end of incarnations whose end no manager observed; remove half-written records.

        A manager calls it when it starts, before it writes records of its own.

        Args:
            living: The marks of incarnations that may have processes or folders.
            now: The time.
        """
        self._remove_unfinished()
        for kept in list(self._all()):
            if not kept.record.ended and kept.record.incarnation_id not in living:
                self._settle(kept, now)

    def settle_one(self, incarnation_id: str, now: float) -> None:
        """Record the end of an incarnation whose end no manager observed."""
        kept = self.find(incarnation_id)
        if kept is not None:
            self._settle(kept, now)

    def _settle(self, kept: Kept, now: float) -> None:
        words = last_line(kept.folder)
        reason = "no manager saw it end" + (f"; its last output: {words}" if words else "")
        self.end(kept.record.id, kept.record.incarnation_id, reason, now)

    def prune(self, now: float) -> None:
        """Remove logs that exceed the age or space limit, the oldest first."""
        ended = sorted((kept for kept in self._all() if kept.record.ended), key=_age)
        space = self._space
        incarnations: dict[str, int] = {}
        for kept in ended:
            space -= size_of(kept.folder)
            incarnations[kept.record.id] = incarnations.get(kept.record.id, 0) + 1
            is_old = now - kept.record.ended > self._days * _DAY_S
            if is_old or space < 0 or incarnations[kept.record.id] > MAX_INCARNATIONS:
                self._remove(kept.folder)

    def _remove(self, folder: Path) -> None:
        remove(folder)
        with self._lock, contextlib.suppress(OSError):
            _record(folder).unlink()
            _remove_empty(folder.parent)

    def _remove_unfinished(self) -> None:
        """Remove what a manager left that was killed while it wrote a record."""
        for folder in list(self._tags()):
            with self._lock, contextlib.suppress(OSError):
                for path in _children(folder):
                    if path.suffix == UNFINISHED:
                        path.unlink()
                _remove_empty(folder)

    def _folder(self, id_: str) -> Path:
        endpoint = EndpointId.parse(id_)
        return self._root / endpoint.user / endpoint.tag

    def _all(self) -> Iterator[Kept]:
        for folder in self._tags():
            yield from self._incarnations(folder)

    def _tags(self) -> Iterator[Path]:
        """The folders of all containers."""
        for user in _children(self._root):
            yield from _children(user)

    def _incarnations(self, folder: Path) -> Iterator[Kept]:
        """The incarnations of one container."""
        for path in _children(folder):
            if path.suffix == ".json" and (kept := _kept(path.with_suffix(""))) is not None:
                yield kept


def _children(folder: Path) -> list[Path]:
    """List a folder; an incarnation may be pruned meanwhile, so a missing folder counts as empty."""
    try:
        return list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def _remove_empty(folder: Path) -> None:
    """Remove the folder of a container, and that of its user, if they are empty."""
    with contextlib.suppress(OSError):  # not empty
        folder.rmdir()
        folder.parent.rmdir()


def _kept(folder: Path) -> Kept | None:
    record = _read(folder)
    return Kept(record, folder) if record is not None and record.incarnation_id == folder.name else None


def _age(kept: Kept) -> float:
    return -kept.record.ended


def _record(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.json")


def _read(folder: Path) -> IncarnationRecord | None:
    try:
        return msgspec.json.decode(_record(folder).read_bytes(), type=IncarnationRecord)
    except (OSError, msgspec.DecodeError):
        return None


def _write(folder: Path, record: IncarnationRecord) -> None:
    """Write an incarnation's record, atomically."""
    write_whole(_record(folder), msgspec.json.encode(record))
