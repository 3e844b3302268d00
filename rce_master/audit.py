"""The audit log: logins, refusals and changes, as JSON lines in rotated files.

Records contain no secrets: no passwords, tokens or values of parameters, and not even the names of unknown
users, because users sometimes type their password as the name.
"""

from __future__ import annotations

import logging
import os
import re
from collections import OrderedDict, deque
from errno import ENOSPC
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec
from msgspec import Struct

from rce.config import redact
from rce.guard import Rates
from rce.printable import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from rce_master.state.commands import Command

_log = logging.getLogger(__name__)

AUDIT = "audit"
"""Name of the folder in a master's state folder."""
FILE_NAME = "audit.jsonl"
MAX_BYTES = 8 << 20
"""Bytes of one file; then the next one begins."""
FILES = 10
"""How many files are kept, the one in use included."""
KEPT = 10_000
"""Newest records that the API shows; older ones are in the files."""
REPEAT_S = 60.0
"""Refusals of the same user from the same address within this time are one record."""
MAX_REPEATS = 1000
BURST = 2000
"""Records of one user that are written one by one, however fast they come."""
PER_SECOND = 2.0
"""Records of one user beyond the burst; more of an action and an address within a minute are one record."""
MAX_KINDS = 20
"""Actions and addresses of one user that are counted each for itself beyond the burst."""
OTHER_ACTIONS = "other_actions"
"""The action of a record that counts those beyond :data:`MAX_KINDS`."""
MAX_TEXT = 300
IDS_OF_TERM = 10**10
"""Each term of leadership has ids of its own, so that the records of several masters have one order."""

SHOWN = 5
"""How many of a request's commands are named; the others are counted."""

_UPPER = re.compile(r"(?<!^)(?=[A-Z])")
_NAMES = ("container", "endpoint", "tag", "name", "tag_a", "tag_b")

DONE, REFUSED = "done", "refused"


STATION = "station"
"""The ``via`` of what the user themselves, or a station in their name, told: only the user is checked."""

_Key: TypeAlias = tuple[str, str, str, str, str]
"""User, action, address and outcome, and :data:`STATION` if it was told."""


class Record(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An action that a user performed or was refused."""

    id: int
    """Grows, also from master to master; see :data:`IDS_OF_TERM`."""
    time: float
    """Seconds since 1970."""
    user: str
    """The user; empty if unknown."""
    action: str
    """Such as ``log_in`` or ``create_container``."""
    subject: str = ""
    """The object of the action, such as ``user/container``."""
    outcome: str = DONE
    """``done`` or ``refused``."""
    detail: str = ""
    address: str = ""
    """The address from which the master got it."""
    via: str = ""
    """The robot that passed it on, or :data:`STATION`."""
    client: str = ""
    """The address of the station's client, as the station told it: not checked."""
    times: int = 1
    """How often since the previous record of the same user, action, address and outcome."""


class AuditLog:
    """Keeps the newest records in memory and all records in files, up to a number of files.

    Args:
        folder: The folder of the files; made with the first record, readable by its owner only.
        clock: Seconds since 1970.
        term: Of the leadership, if other masters may lead; 0: there are no others.
        max_bytes: Of one file.
        files: How many are kept.

    Attributes:
        fault: Why the last record is in no file; empty if it is in one.
    """

    def __init__(
        self,
        folder: Path,
        clock: Callable[[], float],
        *,
        term: int = 0,
        max_bytes: int = MAX_BYTES,
        files: int = FILES,
    ) -> None:
        self._folder = folder
        self._file = folder / FILE_NAME
        self._clock = clock
        self._max_bytes = max_bytes
        self._files = files
        self._records: deque[Record] = deque(newest(folder, files), maxlen=KEPT)
        self.first_id = max(term * IDS_OF_TERM, 1)
        """No record of this term has a smaller id."""
        self._next_id = max(self.first_id, self._records[-1].id + 1 if self._records else 0)
        self._descriptor = -1
        self._size = 0
        self.fault = ""
        self._repeated: OrderedDict[_Key, tuple[float, int]] = OrderedDict()
        self._rates = Rates(per_second=PER_SECOND, burst=BURST)

    def add(
        self,
        user: str,
        action: str,
        subject: str = "",
        *,
        detail: str = "",
        address: str = "",
        via: str = "",
        client: str = "",
        outcome: str = DONE,
        times: int = 1,
    ) -> None:
        """Record an action. Those of a user who does too much are counted, so that others' records stay.

        If a record cannot be written, it is kept in memory, the engine's log reports it, and the engine
        continues.
        """
        now = self._clock()
        address = _clean(address)
        if self._is_too_much(user, outcome + _told(via), now):
            self._count_more((user, action, address, outcome, _told(via)), now, times)
            return
        self._add(
            user,
            action,
            now,
            subject=_clean(subject),
            detail=_clean(detail),
            address=address,
            via=_clean(via),
            client=_clean(client),
            outcome=outcome,
            times=times,
        )

    def _add(self, user: str, action: str, now: float, **fields: Any) -> None:
        record = Record(id=self._next_id, time=now, user=_clean(user), action=action, **fields)
        self._next_id += 1
        self._records.append(record)
        self._write(msgspec.json.encode(record) + b"\n")

    def refuse(self, user: str, action: str, *, detail: str = "", address: str = "") -> None:
        """Record a refusal; repetitions are counted and written at most once a minute."""
        now = self._clock()
        address = _clean(address)
        key = user, action, address, REFUSED, ""
        times = self._count(key, now)
        if not times:
            return
        if self._is_too_much(user, REFUSED, now):
            del self._repeated[key]
            self._count_more(key, now, times)
        else:
            detail = _clean(detail)
            self._add(user, action, now, detail=detail, address=address, outcome=REFUSED, times=times)

    def _is_too_much(self, user: str, kind: str, now: float) -> bool:
        # Not one limit for all: others can cause refusals of a user by wrong passwords, and what a user tells
        # must not hide what they do.
        return bool(self._rates.take(f"{kind} {user}", now))

    def _count_more(self, key: _Key, now: float, times: int) -> None:
        """Count what is too much to be written one by one."""
        user, _, _, outcome, told = key
        if key not in self._repeated:
            kinds = sum(1 for one in self._repeated if (one[0], one[3], one[4]) == (user, outcome, told))
            if kinds >= MAX_KINDS:
                key = user, OTHER_ACTIONS, "", outcome, told
        self._add_missed(key, self._count(key, now, times))

    def _count(self, key: _Key, now: float, times: int = 1) -> int:
        """Count a repetition; return how many are to be written now: one or more once a minute, else 0."""
        since, count = self._repeated.get(key, (0.0, 0))
        if not _is_due(since, now):
            self._repeated[key] = (since, count + times)
            return 0
        self._repeated.pop(key, None)
        while len(self._repeated) >= MAX_REPEATS:
            oldest, (_, missed) = self._repeated.popitem(last=False)
            self._add_missed(oldest, missed)
        self._repeated[key] = (now, 0)
        return count + times

    def flush(self) -> None:
        """Write the repetitions that are due."""
        now = self._clock()
        for key in [key for key, (since, _) in self._repeated.items() if _is_due(since, now)]:
            self._add_missed(key, self._repeated.pop(key)[1])

    def since(self, id_: int, limit: int, user: str = "") -> list[Record]:
        """List records as :func:`choose` does."""
        return choose(self._records, id_, limit, user)

    def close(self) -> None:
        """Write the counted repetitions, and close the file."""
        for key, (_, count) in self._repeated.items():
            self._add_missed(key, count)
        self._repeated.clear()
        self._close()

    def _add_missed(self, key: _Key, count: int) -> None:
        user, action, address, outcome, told = key
        if count:
            is_known = outcome == REFUSED and action != OTHER_ACTIONS
            detail = "again" if is_known else "too often to be listed"
            self._add(
                user,
                action,
                self._clock(),
                detail=detail,
                address=address,
                via=told,
                outcome=outcome,
                times=count,
            )

    def _write(self, line: bytes) -> None:
        try:
            if self._descriptor < 0:
                self._open()
            elif self._size + len(line) > self._max_bytes:
                self._turn()
            self._append(line)
            self.fault = ""
        except OSError as error:
            if not self.fault:
                _log.error("the audit log %s cannot be written: %s", self._file, error)
            self.fault = f"the audit log cannot be written: {error.strerror or error}"
            self._close()

    def _append(self, line: bytes) -> None:
        if os.write(self._descriptor, line) < len(line):  # what follows a part must begin a new line
            raise OSError(ENOSPC, os.strerror(ENOSPC))
        self._size += len(line)

    def _open(self) -> None:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._descriptor = os.open(self._file, flags, 0o600)
        self._size = os.fstat(self._descriptor).st_size
        if self._size and os.pread(self._descriptor, 1, self._size - 1) != b"\n":
            self._size += os.write(self._descriptor, b"\n")  # a crash cut the last line off
        if self._size >= self._max_bytes:
            self._turn()

    def _turn(self) -> None:
        """Begin a new file; remove the oldest one."""
        self._close()
        for number in range(self._files - 1, 0, -1):
            older = _numbered(self._folder, number - 1)
            if older.exists():
                older.replace(_numbered(self._folder, number))
        self._open()

    def _close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def choose(records: Iterable[Record], since: int, limit: int, user: str = "") -> list[Record]:
    """List records after an id, oldest first; with a negative id, the newest ``-since`` ones.

    Args:
        records: Ordered by id.
        since: The last known record.
        limit: Maximum number of records.
        user: Only of this user; empty: of all.
    """
    found = [one for one in records if (since < 0 or one.id > since) and (not user or one.user == user)]
    return found[max(since, -limit) :] if since < 0 else found[:limit]


def newest(folder: Path, files: int = FILES) -> list[Record]:
    """Read the newest records of a log's files, oldest first."""
    found: list[Record] = []
    for file in log_files(folder, files):
        found = [*_read(file), *found]
        if len(found) >= KEPT:
            break
    return found[-KEPT:]


def log_files(folder: Path, files: int = FILES) -> Iterator[Path]:
    """Return the possible files of a log, newest first.

    A file that is put aside while they are read in this order comes again, and none is left out.
    """
    return (_numbered(folder, number) for number in range(files))


def _is_due(since: float, now: float) -> bool:
    """Return whether repetitions are to be written; also after the clock was set back."""
    return not 0 <= now - since < REPEAT_S


def _numbered(folder: Path, number: int) -> Path:
    return folder / f"{FILE_NAME}.{number}" if number else folder / FILE_NAME


def _told(via: str) -> str:
    return STATION if via == STATION else ""


def _clean(text: str) -> str:
    """Return a text as one line of bounded length, without parts that look like tokens or passwords."""
    return redact(one_line(text[:MAX_TEXT]))


def _read(file: Path) -> Iterator[Record]:
    """Read the records of a file, except a line that was cut off by a crash."""
    try:
        lines = file.read_bytes().splitlines()
    except FileNotFoundError:
        return
    except OSError as error:
        _log.warning("the audit log %s cannot be read: %s", file, error)
        return
    for line in lines:
        try:
            yield msgspec.json.decode(line, type=Record)
        except msgspec.MsgspecError:
            _log.warning("the audit log %s has an unreadable line", file)


def describe(commands: Sequence[Command]) -> str:
    """Return a short description of the commands of one request."""
    words = [_describe(command) for command in commands[:SHOWN]]
    more = len(commands) - len(words)
    return ", ".join(words) + (f", and {more} more" if more else "")


def _describe(command: Command) -> str:
    action = _UPPER.sub(" ", type(command).__name__).lower()
    names = [getattr(command, name, "") for name in _NAMES]
    names += [_tag_of(getattr(command, part, None)) for part in ("node", "interface")]
    return f"{action} {' '.join(name for name in names if name)}"


def _tag_of(part: Any) -> str:
    return str(getattr(part, "tag", ""))
