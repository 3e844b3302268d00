"""Backups of a master's state: made while it runs, restored while it does not run. Blocks.

A copy is a tar file: ``master/`` (the store, users' packages, other files of the master's folder),
``certificates/`` if the engine has some, and, last, ``manifest.json`` with the hash of each file. SQLite
copies the store in one step, so the copy is consistent. A copy holds password hashes and keys: only its owner
can read its file.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import sqlite3
import stat
import tarfile
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import IO, Any, TypeAlias

import msgspec

from rce import __version__
from rce_master.audit import AUDIT, log_files
from rce_master.exceptions import StoreError
from rce_master.packages.contents import ARCHIVES
from rce_master.snapshots.service import SNAPSHOTS
from rce_master.state.tables import Tables
from rce_master.state.user_records import UserPackage
from rce_master.store.base import SCHEMA_VERSION
from rce_master.store.lock import UNFINISHED_RESTORE, FolderLock, check_restored
from rce_master.store.sqlite import FILE_NAME

FORMAT = 1
MASTER, CERTIFICATES = "master", "certificates"
MANIFEST = "manifest.json"

Export: TypeAlias = Callable[[], AbstractContextManager[Path]]
"""Gives a store as an SQLite file."""

_ATTEMPTS = 5
_STORE = {FILE_NAME, f"{FILE_NAME}-wal", f"{FILE_NAME}-shm", f"{FILE_NAME}-journal"}
_LEFT_OUT = {*_STORE, "lock", ARCHIVES, SNAPSHOTS, "etcd"}
"""What is copied in another way, snapshots, which have the users' files, and a member of etcd, if it has the
same state folder."""
_OF_ETCD = "etcd."
"""How the names of its other files begin: its configuration, and data that ``rce cluster recover`` keeps."""
_OF_RESTORE = {"lock", UNFINISHED_RESTORE}
"""Files that stay in a state folder: the lock is held, and by the other one masters refuse the folder."""
_PIECE = 1 << 20


class BackupError(StoreError):
    """A copy cannot be made or restored."""


@dataclass(frozen=True, slots=True)
class Copy:
    """The manifest of a copy."""

    created: float
    """Seconds since 1970."""
    version: str
    """Version of the program that made it."""
    files: int
    size: int
    """Bytes of all files."""


def back_up(folders: Mapping[str, Path], out: Path, export: Export | None = None) -> Copy:
    """Copy a master's state, also while it runs.

    Args:
        folders: Its parts: the master's folder, and that of certificates.
        out: The file to make. It appears complete or not at all.
        export: Gives an SQLite file with the contents of a store that is elsewhere.

    Raises:
        StoreError: A restore to the folder did not finish.
        BackupError: The folder has no state, the state cannot be copied, or the file exists already or
            would be in a folder that is copied.
    """
    store = folders[MASTER] / FILE_NAME
    if export is None and not store.exists():
        raise BackupError(
            f"{folders[MASTER]} is not a master's state folder: it has no {FILE_NAME}; "
            "name the folder with --state-dir or --config; for a state in etcd, add --store etcd://HOST:PORT"
        )
    check_restored(folders[MASTER])
    if out.exists():
        raise BackupError(f"{out} is there already; name another file, or remove it")
    for folder in folders.values():
        if out.resolve().is_relative_to(folder.resolve()):
            raise BackupError(f"{out} would be a part of the next backup: name a file outside of {folder}")
    try:
        descriptor, name = tempfile.mkstemp(dir=out.parent, prefix=f".{out.name}-")
        try:
            with os.fdopen(descriptor, "wb") as aside:
                made = _write_again(folders, aside, export or partial(_snapshot, store))
            Path(name).rename(out)
        except BaseException:
            Path(name).unlink()
            raise
    except OSError as error:
        raise BackupError(f"cannot make {out}: {error}") from error
    return made


def restore(file: Path, folders: Mapping[str, Path], *, replace: bool = False) -> tuple[Copy, list[Path]]:
    """Restore a copy's state into folders.

    The whole copy is read and checked before any file changes. If it is interrupted later, masters refuse the
    folder until it was repeated.

    Args:
        file: The copy.
        folders: The folders of its parts.
        replace: Move existing state aside, to ``FOLDER.before-DATE``. By root, a certificate or key that
            replaces one keeps its owner and permissions: a service of another user may read some of them.

    Returns:
        The copy's manifest, and the folders of the former state.

    Raises:
        StoreBusyError: A master runs on the folder.
        BackupError: The copy is incomplete or was made by a newer program, or the folder already has state.
    """
    master = folders[MASTER]
    aside: list[Path] = []
    marker = master / UNFINISHED_RESTORE
    with locked(master):
        there = [folder for folder in folders.values() if _holds_state(folder)]
        there = [folder for folder in there if not _is_inside(folder, master)]  # they are moved with it
        if there and not replace:
            raise BackupError(f"there is state in {there[0]}; to move it aside, give --replace")
        try:
            with tempfile.TemporaryDirectory(dir=master.parent, prefix=".rce-restore-") as name:
                found = extract(file, Path(name))
                check_store(Path(name) / MASTER / FILE_NAME)
                _write_marker(marker)
                stamp = _free_stamp(folders.values())
                for folder in there:
                    former = folder.with_name(f"{folder.name}.before-{stamp}")
                    former.mkdir(mode=0o700)
                    aside.append(former)
                    _move_aside(folder, former)
                for part, folder in folders.items():
                    _move(Path(name) / part, folder)
                    if part == CERTIFICATES:
                        _keep_owners(folder, folder.with_name(f"{folder.name}.before-{stamp}"))
                for folder in folders.values():
                    _sync_folder(folder)
                marker.unlink()
                _sync_folder(master)
        except (OSError, tarfile.TarError) as error:
            places = " and ".join(map(str, aside))
            hint = f"; the former state is in {places}: to use it again, move it back" if aside else ""
            hint += f" and remove {marker}" if hint and marker.exists() else ""
            raise BackupError(f"cannot restore {file}: {error}{hint}") from error
    return found, aside


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock on a state folder. After an error, remove the folders that were made for it."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    lock = FolderLock(folder, restores=True)
    try:
        yield
    except BaseException:
        if made:
            lock.remove()
        for path in made:
            with suppress(OSError):  # it is used by others meanwhile
                path.rmdir()
        raise
    finally:
        lock.close()


class _PackageRemovedError(BackupError):
    """A package was removed after the store was copied: the copy would lack what its store names."""


def _write_again(folders: Mapping[str, Path], out: IO[bytes], export: Export) -> Copy:
    """Write a copy; retry if packages were removed meanwhile."""
    for _ in range(_ATTEMPTS - 1):
        try:
            return _write(folders, out, export)
        except _PackageRemovedError:
            out.seek(0)
            out.truncate()
    return _write(folders, out, export)


def _write(folders: Mapping[str, Path], out: IO[bytes], export: Export) -> Copy:
    hashes: dict[str, str] = {}
    size = 0
    logs: set[tuple[int, int]] = set()
    """The files of the audit log that are in the copy, by device and inode."""
    with (
        export() as store,
        tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar,
    ):
        _leave_states_out(store)
        for name, path in _files(folders, store):
            try:
                with path.open("rb") as source:
                    if name.startswith(f"{MASTER}/{AUDIT}/"):
                        status = os.fstat(source.fileno())
                        if (status.st_dev, status.st_ino) in logs:
                            continue  # it was put aside meanwhile, and is in the copy by its former name
                        logs.add((status.st_dev, status.st_ino))
                    size += _add(tar, name, source, hashes)
            except FileNotFoundError as error:
                if path.parent.name == ARCHIVES:
                    raise _PackageRemovedError(
                        f"{path} is not there: it was removed while it was copied, or another master has it;"
                        " then run this on the machine of the leading master"
                    ) from error
                # A file that was removed meanwhile: the master does not need it.
        created = time.time()
        manifest = {
            "format": FORMAT,
            "rce": __version__,
            "schema": SCHEMA_VERSION,
            "created": created,
            "size": size,
            "files": hashes,
        }
        data = json.dumps(manifest, indent=1).encode()
        info = tarfile.TarInfo(MANIFEST)
        info.size, info.mode, info.mtime = len(data), 0o600, int(created)
        tar.addfile(info, io.BytesIO(data))
    out.flush()
    os.fsync(out.fileno())
    return Copy(created, __version__, len(hashes), size)


def _leave_states_out(store: Path) -> None:
    """Leave the saved states of nodes out of a copy: they change all the time, also while it is made."""
    try:
        with closing(sqlite3.connect(store)) as database, database:
            database.execute("DELETE FROM record WHERE kind = ?", (Tables().saved_states.name,))
    except sqlite3.Error as error:
        raise BackupError(f"cannot write the copy of the store: {error}") from error


def _add(tar: tarfile.TarFile, name: str, source: IO[bytes], hashes: dict[str, str]) -> int:
    """Add the present contents of a file; it may grow meanwhile."""
    status = os.fstat(source.fileno())
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = status.st_size, status.st_mode & 0o700, int(status.st_mtime)
    reader = _Hashing(source)
    tar.addfile(info, reader)
    hashes[name] = reader.hash.hexdigest()
    return info.size


class _Hashing:
    """Hashes a file while it is read."""

    def __init__(self, source: IO[bytes]) -> None:
        self._source = source
        self.hash = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        """Read a piece."""
        piece = self._source.read(size)
        self.hash.update(piece)
        return piece


@contextmanager
def _snapshot(store: Path) -> Iterator[Path]:
    """Copy the store in one step of SQLite; remove the copy at the end."""
    with tempfile.TemporaryDirectory(prefix="rce-backup-") as name:
        path = Path(name) / FILE_NAME
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
        try:
            with (
                closing(sqlite3.connect(f"{store.absolute().as_uri()}?mode=ro", uri=True)) as source,
                closing(sqlite3.connect(path)) as copy,
            ):
                source.backup(copy)
                copy.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.Error as error:
            raise BackupError(f"cannot copy the store {store}: {error}") from error
        check_store(path)
        yield path


def _files(folders: Mapping[str, Path], store: Path) -> Iterator[tuple[str, Path]]:
    """Return the files of a copy: the store, the packages that it names, and other files of the folders."""
    yield f"{MASTER}/{FILE_NAME}", store
    master = folders[MASTER]
    for sha256 in sorted({package.sha256 for package in packages_in(store)}):
        yield f"{MASTER}/{ARCHIVES}/{sha256}", master / ARCHIVES / sha256
    logs = list(log_files(master / AUDIT))
    for log in logs:
        yield f"{MASTER}/{AUDIT}/{log.name}", log
    certificates = folders.get(CERTIFICATES)
    for part, folder in folders.items():
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            left_out = part == MASTER and (
                inside.parts[0] in _LEFT_OUT
                or inside.parts[0].startswith(_OF_ETCD)
                or path in logs
                or (certificates is not None and path.is_relative_to(certificates))
            )
            if path.is_file() and not path.is_symlink() and not left_out:
                yield f"{part}/{inside.as_posix()}", path


def packages_in(store: Path) -> Iterator[UserPackage]:
    """Return the packages that a store names."""
    with closing(sqlite3.connect(f"{store.as_uri()}?mode=ro", uri=True)) as database:
        rows = database.execute("SELECT key, body FROM record WHERE kind = ?", (Tables().packages.name,))
        for _, body in rows:
            yield msgspec.json.decode(body, type=UserPackage)


def check_store(path: Path) -> None:
    """Check a store's integrity, and that this program knows its version."""
    try:
        with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as database:
            (version,) = database.execute("PRAGMA user_version").fetchone()
            (sound,) = database.execute("PRAGMA quick_check").fetchone()
    except sqlite3.Error as error:
        raise BackupError(f"the store in it cannot be read: {error}") from error
    if sound != "ok":
        raise BackupError(f"the store in it is damaged: {sound}")
    if version > SCHEMA_VERSION:
        raise BackupError(
            f"its store has version {version}, this program knows versions up to {SCHEMA_VERSION}: install"
            " the program that made it, or a newer one"
        )


def extract(file: Path, target: Path) -> Copy:
    """Extract a copy's files into a folder, and check all of them."""
    hashes: dict[str, str] = {}
    manifest: dict[str, Any] | None = None
    with file.open("rb") as source, tarfile.open(fileobj=source, mode="r:") as tar:
        for member in tar:
            content = tar.extractfile(member) if member.isreg() else None
            place = PurePosixPath(member.name)
            if content is None or place.is_absolute() or ".." in place.parts:
                raise BackupError(f"{file} holds {member.name!r}, which no backup does")
            if member.name == MANIFEST:
                manifest = _read_manifest(file, content.read())
            elif place.parts[0] in (MASTER, CERTIFICATES):
                hashes[member.name] = _write_file(target / place, content, member.mode)
    if manifest is None:
        raise BackupError(f"{file} is not a whole backup: it has no {MANIFEST} at its end")
    differing = sorted(set(hashes.items()) ^ set(manifest["files"].items()))
    if differing or f"{MASTER}/{FILE_NAME}" not in hashes:
        name = differing[0][0] if differing else FILE_NAME
        raise BackupError(f"{file} is damaged: {name} is not what was saved")
    return Copy(manifest["created"], manifest["rce"], len(hashes), manifest["size"])


def _read_manifest(file: Path, data: bytes) -> dict[str, Any]:
    try:
        manifest = json.loads(data)
        version = manifest["format"]
        if version > FORMAT or manifest["schema"] > SCHEMA_VERSION:
            raise BackupError(
                f"{file} was made by rce {manifest['rce']}, which is newer than this program ({__version__})"
            )
        dict(manifest["files"]), float(manifest["created"]), int(manifest["size"])
    except (ValueError, KeyError, TypeError) as error:
        raise BackupError(f"{file} is damaged: its {MANIFEST} cannot be read") from error
    return dict(manifest)


def _write_file(path: Path, content: IO[bytes], mode: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    made = hashlib.sha256()
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode & 0o700)
    with os.fdopen(descriptor, "wb") as out:
        while piece := content.read(_PIECE):
            made.update(piece)
            out.write(piece)
        out.flush()
        os.fsync(out.fileno())
    return made.hexdigest()


def _holds_state(folder: Path) -> bool:
    return folder.is_dir() and any(path.name not in _OF_RESTORE for path in folder.iterdir())


def _free_stamp(folders: Collection[Path]) -> str:
    """Return the time, with a number if a former state was moved aside in the same second."""
    now = time.strftime("%Y%m%d-%H%M%S")
    stamps = chain([now], (f"{now}-{number}" for number in count(2)))
    return next(
        stamp
        for stamp in stamps
        if not any(folder.with_name(f"{folder.name}.before-{stamp}").exists() for folder in folders)
    )


def _is_inside(folder: Path, other: Path) -> bool:
    return other.resolve() in folder.resolve().parents


def _write_marker(marker: Path) -> None:
    marker.touch(mode=0o600)
    _sync_folder(marker.parent)


def _sync_folder(folder: Path) -> None:
    """Have the names in a folder survive a power cut."""
    if folder.is_dir():
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _move_aside(folder: Path, aside: Path) -> None:
    for path in folder.iterdir():
        if path.name not in _OF_RESTORE:
            path.rename(aside / path.name)


def _move(source: Path, folder: Path) -> None:
    """Move the extracted files to their places; the store last, so that it never exists alone."""
    if not source.is_dir():
        return
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for path in sorted(source.iterdir(), key=lambda path: path.name == FILE_NAME):
        shutil.move(path, folder / path.name)


def _keep_owners(folder: Path, former: Path) -> None:
    """Give restored files the owners and permissions of those that they replace."""
    if os.geteuid() != 0 or not former.is_dir():
        return
    # The folder may be another user's: nothing that this user links to changes.
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    for path in former.iterdir():
        was = path.lstat()
        with suppress(FileNotFoundError):
            fd = os.open(folder / path.name, flags)
            try:
                found = os.fstat(fd)
                if stat.S_ISREG(was.st_mode) and stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
                    os.fchown(fd, was.st_uid, was.st_gid)
                    os.fchmod(fd, stat.S_IMODE(was.st_mode))
            finally:
                os.close(fd)
