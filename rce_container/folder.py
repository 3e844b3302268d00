"""The folders of a container task set on disk.

``STATE/name``, one folder per life of a container, ``STATE/containers/MARK`` (record, private home), and its
logs, which outlive it (:mod:`rce_container.archive`), are in the state directory; the container's sockets are
in a short path, ``RUN/MARK``. Everything belongs to one task set at a time: the state directory is locked
while it runs.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import secrets
import socket
import time
from pathlib import Path
from typing import Self

import msgspec
from msgspec import Struct, field

from rce_container.archive import LOG_DAYS, LOG_SPACE, LogArchive
from rce_container.environment import proc
from rce_container.exceptions import StateBusyError, StateError
from rce_container.files import remove, write_whole

_log = logging.getLogger(__name__)

_INCARNATION_ID = re.compile(r"[0-9a-f]{12}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}")
_MAX_SOCKET_PATH = 107


class Record(Struct, frozen=True, kw_only=True):
    """The record by which a manager adopts a container that an earlier manager started."""

    id: str
    incarnation_id: str = field(name="mark")
    runtime: str
    pid: int
    """The outermost process of the container."""
    start: int
    """Its start time, which distinguishes it from a process with a reused pid."""
    namespaces_pid: int = 0
    """See :attr:`rce_container.runtimes.base.Handle.namespaces_pid`."""
    environment: int = 0
    """The environment's pid, if it does not descend from the outermost process; else 0."""
    environment_start: int = 0
    group: str = ""
    """The group whose private network it is in; empty without one."""
    address: str = ""
    """Its address there, with the prefix."""
    volumes: dict[str, str] = {}
    """Its volumes: where it sees them, by name."""
    revision: int = 0
    """The newest revision that its environment was given."""


class ContainerFolder:
    """The paths of one incarnation of one container.

    Args:
        root: Holds the folders of all incarnations.
        run: Holds those for sockets.
        incarnation_id: Names the incarnation.
        logs: Where its logs are; by default in its own folder.
    """

    def __init__(self, root: Path, run: Path, incarnation_id: str, logs: Path | None = None) -> None:
        self.incarnation_id = incarnation_id
        self.path = root / incarnation_id
        self.run = run / incarnation_id
        self.home = self.path / "home"
        self.logs = logs or self.path / "logs"
        self.etc = self.path / "etc"
        self.user_packages = self.path / "bundles"
        self.hosts = self.etc / "hosts"
        self.control_socket = self.run / "control.sock"
        self.link_socket = self.run / "link.sock"

    def make(self) -> None:
        """Make the folders, for the owner only.

        Raises:
            StateError: They cannot be made.
        """
        try:
            for path in (self.path, self.run, self.home, self.etc):
                path.mkdir(mode=0o700, parents=True)
            self.logs.mkdir(mode=0o700, exist_ok=True)
            self.user_packages.mkdir()
            self.user_packages.chmod(0o755)  # readable by the container's user, who alone can reach it
        except OSError as error:
            raise StateError(f"cannot make {error.filename}: {error.strerror}") from error

    def listen(self, path: Path) -> socket.socket:
        """Bind a listening unix socket.

        Raises:
            StateError: It cannot be bound.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            sock.bind(str(path))
            sock.listen(128)
        except OSError as error:
            sock.close()
            raise StateError(f"cannot listen on {path}: {error}") from error
        return sock

    def write_record(self, record: Record) -> None:
        """Write the record of the container, atomically.

        Raises:
            StateError: It cannot be written.
        """
        try:
            write_whole(self.path / "record.json", msgspec.json.encode(record))
        except OSError as error:
            raise StateError(f"cannot write {error.filename}: {error.strerror}") from error

    def read_record(self) -> Record | None:
        """Return the record; None if it was never completely written."""
        try:
            return msgspec.json.decode((self.path / "record.json").read_bytes(), type=Record)
        except (OSError, msgspec.DecodeError):
            return None

    def note_revision(self, revision: int) -> None:
        """Write the newest revision that the environment was given; a later manager trusts only this one.

        Raises:
            StateError: It cannot be written.
        """
        record = self.read_record()
        if record is not None and record.revision < revision:
            self.write_record(msgspec.structs.replace(record, revision=revision))

    def remove(self) -> None:
        """Remove everything, including files that a node made unreadable. Blocks; may be repeated."""
        for path in (self.run, self.path):
            remove(path)
            if path.exists():
                make_accessible(path)
                remove(path)


def make_accessible(root: Path) -> None:
    """Undo a node's changes to the permissions of its folders. Does not follow links."""
    waiting = [str(root)]
    while waiting:
        folder = waiting.pop()
        with contextlib.suppress(OSError):
            os.chmod(folder, 0o700)  # noqa: PTH101 - there may be very many
            with os.scandir(folder) as entries:
                waiting += [entry.path for entry in entries if entry.is_dir(follow_symlinks=False)]


class StateFolder:
    """The state directory of a container task set. A context manager: locked while it is open.

    Args:
        state: Path of the state directory.
        run: A short path for sockets; one folder per state directory is made in it.
        log_days: How long the logs of a container are kept after its end.
        log_space: How many bytes those logs may take in all.

    Attributes:
        archive: The containers' logs.
    """

    def __init__(
        self, state: Path, run: Path, *, log_days: float = LOG_DAYS, log_space: int = LOG_SPACE
    ) -> None:
        self._state = state.absolute()
        self._containers = self._state / "containers"
        self.archive = LogArchive(self._state / "logs", days=log_days, space=log_space)
        self._run_base = run
        self._run = run
        self._lock = -1

    def __enter__(self) -> Self:
        try:
            self._take()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _take(self) -> None:
        try:
            self._containers.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(self._state / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._note_owner()
            self._run = self._run_base / f"c-{self.token}"
            self._run.mkdir(mode=0o700, parents=True, exist_ok=True)
        except BlockingIOError as error:
            raise StateBusyError(
                f"another rce-container uses {self._state}; give this one its own --state-dir"
            ) from error
        except OSError as error:
            raise StateError(f"cannot use the state directory {self._state}: {error}") from error
        longest = len(os.fsencode(self._run / ("0" * 12) / "control.sock"))
        if longest > _MAX_SOCKET_PATH:
            raise StateError(
                f"the path {self._run} is too long for sockets; set XDG_RUNTIME_DIR to a shorter one"
            )

    def _note_owner(self) -> None:
        own = proc.read(os.getpid())
        os.truncate(self._lock, 0)
        os.pwrite(self._lock, f"{own.pid} {own.start}\n".encode() if own is not None else b"", 0)

    def owner(self) -> proc.Process | None:
        """Return the process that holds the state directory; None if it does not run or left no note."""
        try:
            pid, start = map(int, (self._state / "lock").read_text().split())
        except (OSError, ValueError):
            return None
        found = proc.read(pid)
        return found if found is not None and found.start == start else None

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._run.rmdir()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def name(self, requested: str) -> str:
        """Return the task set's name: ``requested``, or its former one, or a new one. It is kept.

        Raises:
            StateError: ``requested`` cannot be a name.
        """
        if requested:
            if not _NAME.fullmatch(requested):
                raise StateError(
                    f"{requested!r} cannot name a task set: use letters, digits, '_', '-' and '.'"
                )
            self._keep(self._state / "name", requested, durable=True)
        return self._word("name", f"container-{secrets.token_hex(4)}")

    @property
    def term(self) -> int:
        """The newest term of leadership that a task set saw with this state directory; 0: none.

        Raises:
            StateError: The file cannot be read, or holds no number.
        """
        text = self._word("term", "0")
        if not text.isdecimal():
            raise StateError(f"{self._state / 'term'} must hold a number, found {text!r:.40}; remove it")
        return int(text)

    def keep_term(self, term: int) -> None:
        """Keep the newest term of leadership, if that can be written."""
        try:
            self._keep(self._state / "term", str(term))
        except StateError as error:
            _log.warning("the term %d is forgotten when this program ends: %s", term, error)

    @property
    def token(self) -> str:
        """A permanent name of this state directory on its machine."""
        return self._word("run", secrets.token_hex(4))

    @property
    def library(self) -> Path:
        """Where packages that users bring are kept."""
        return self._state / "bundles"

    @property
    def requirements(self) -> Path:
        """Where the requirements of those packages are kept."""
        return self._state / "requirements"

    @property
    def volumes(self) -> Path:
        """Where the volumes of users are."""
        return self._state / "volumes"

    @property
    def cgroups(self) -> Path:
        """A file that says where the containers' cgroups are."""
        return self._state / "cgroups"

    def create(self, id_: str) -> ContainerFolder:
        """Make the folder of a new incarnation of a container.

        Raises:
            StateError: It cannot be made.
        """
        incarnation_id = secrets.token_hex(6)
        logs = self.archive.begin(id_, incarnation_id, time.time())
        folder = ContainerFolder(self._containers, self._run, incarnation_id, logs)
        try:
            folder.make()
        except StateError as error:
            folder.remove()
            self.archive.end(id_, incarnation_id, str(error), time.time())
            raise
        return folder

    def existing(self) -> list[ContainerFolder]:
        """Return all existing folders of incarnations, by id."""
        incarnation_ids = {path.name for parent in (self._containers, self._run) for path in parent.iterdir()}
        logs = self.archive.folders()
        return [
            ContainerFolder(self._containers, self._run, incarnation_id, logs.get(incarnation_id))
            for incarnation_id in sorted(incarnation_ids)
            if _INCARNATION_ID.fullmatch(incarnation_id)
        ]

    def _word(self, file: str, default: str) -> str:
        path = self._state / file
        try:
            word = path.read_text(errors="replace").strip()
        except OSError:
            word = ""
        if not _NAME.fullmatch(word):
            word = default
            self._keep(path, word, durable=True)  # volumes belong to a task set of this name
        return word

    def _keep(self, path: Path, word: str, *, durable: bool = False) -> None:
        try:
            write_whole(path, word.encode(), durable=durable)
        except OSError as error:
            raise StateError(f"cannot write {path}: {error.strerror}") from error
