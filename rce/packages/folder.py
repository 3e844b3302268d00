"""A package's folder on its owner's machine: the files to pack, and the faults that prevent packing."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rce.model import is_version
from rce.packages import ignore
from rce.packages.archive import ArchiveWriter, make_header
from rce.packages.contents import Contents, describe
from rce.packages.exceptions import BadArchiveError
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits
from rce.packages.requirements import FILE_NAME as REQUIREMENTS
from rce.packages.tree import Entry, Kind, Tree, path_fault
from rce.ros.errors import BadPackageError
from rce.ros.packages import MANIFESTS, parse_manifest

_CHUNK = 1 << 16
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class Source(NamedTuple):
    """A package's folder that can be a package."""

    folder: Path
    tree: Tree
    contents: Contents
    version: str

    def pack(self, file: BinaryIO) -> None:
        """Write the archive. Blocks.

        Raises:
            BadArchiveError: A file changed meanwhile, or cannot be read.
        """
        with ArchiveWriter(file) as archive:
            for entry in self.tree.entries.values():
                archive.add(entry, self._data(entry) if entry.kind is Kind.FILE else ())

    def _data(self, entry: Entry) -> Iterator[bytes]:
        path = self.folder.joinpath(*entry.parts[1:])
        try:
            with os.fdopen(os.open(path, _READ), "rb") as file:
                while chunk := file.read(_CHUNK):
                    yield chunk
        except OSError as error:
            raise BadArchiveError(f"{path}: {error.strerror}") from error


def look_into(folder: Path, version: str = "", limits: ArchiveLimits = DEFAULT_LIMITS) -> Source:
    """Inspect a package's folder. Blocks.

    Args:
        folder: Holds the manifest.
        version: Instead of the one in the manifest.
        limits: How large a package may be.

    Raises:
        BadArchiveError: The folder cannot be packed; the error has all faults.
    """
    folder = folder.absolute()
    texts = _texts(folder, limits)
    name = _name(folder, texts)
    entries, faults = _collect(folder, name)
    tree = Tree(limits)
    for entry in sorted(entries, key=lambda entry: entry.parts):
        try:
            make_header(entry)
            tree.add(entry)
        except BadArchiveError as error:
            faults += error.faults
            if len(tree.entries) > limits.entries or tree.size > limits.unpacked:
                break
    if faults:
        raise BadArchiveError(faults)
    tree.finish()
    contents = describe(tree, {key: text for key, text in texts.items() if f"{name}/{key}" in tree.entries})
    return Source(folder, tree, contents, _version(version, contents))


def _texts(folder: Path, limits: ArchiveLimits) -> dict[str, bytes]:
    if not folder.is_dir():
        raise BadArchiveError(f"{folder} is not a folder")
    texts = {}
    for name in (*MANIFESTS, REQUIREMENTS):
        file = folder / name
        if file.is_file() and not file.is_symlink():
            try:
                with file.open("rb") as opened:
                    texts[name] = opened.read(limits.manifest + 1)
            except OSError as error:
                raise BadArchiveError(f"{file}: {error.strerror}") from error
            if len(texts[name]) > limits.manifest:
                raise BadArchiveError(f"{file} has more than {limits.manifest} bytes")
    return texts


def _name(folder: Path, texts: dict[str, bytes]) -> str:
    manifest = next((name for name in MANIFESTS if name in texts), None)
    if manifest is None:
        raise BadArchiveError(
            f"{folder} is not a package: it has no {' or '.join(MANIFESTS)}; write a package.yaml with the"
            " lines 'name: ...' and 'version: ...'"
        )
    try:
        return parse_manifest(folder / manifest, texts[manifest], folder.resolve().name).name
    except BadPackageError as error:
        raise BadArchiveError(str(error)) from error


def _version(requested: str, contents: Contents) -> str:
    version = requested or contents.version
    if not version:
        raise BadArchiveError(
            "the package has no version: give --version, or write one into the manifest (in package.yaml in"
            " quotes, version: '1.2.0')"
        )
    if not is_version(version):
        raise BadArchiveError(
            f"{version!r} is not a version: use up to four numbers, such as 1.2.0, and a label if it is not a"
            " release yet, such as 1.3-rc1"
        )
    return version


def _collect(folder: Path, name: str) -> tuple[list[Entry], list[str]]:
    entries = [Entry(path=name, kind=Kind.FOLDER)]
    faults: list[str] = []
    ignored = ignore.Ignore.parse(_ignore_text(folder))
    waiting: list[tuple[str, ...]] = [()]
    while waiting:
        inner = waiting.pop()
        try:
            found = list(os.scandir(folder.joinpath(*inner)))
        except OSError as error:
            faults.append(f"{error.filename}: {error.strerror}")
            continue
        for item in found:
            parts = (*inner, item.name)
            is_folder = item.is_dir(follow_symlinks=False)
            if ignored.matches(parts, is_folder=is_folder):
                continue
            entry = _entry("/".join((name, *parts)), item)
            if isinstance(entry, str):
                faults.append(entry)
                continue
            entries.append(entry)
            if is_folder:
                waiting.append(parts)
    return entries, faults


def _entry(path: str, item: os.DirEntry[str]) -> Entry | str:
    shown = repr(path.partition("/")[2])
    fault = path_fault(path)
    if fault:
        return f"{shown}: {fault}"
    try:
        found = item.stat(follow_symlinks=False)
        return _entry_of(path, Path(item.path), found) or f"{shown}: {_odd(found.st_mode)}"
    except OSError as error:
        return f"{shown}: {error.strerror}"


def _entry_of(path: str, file: Path, found: os.stat_result) -> Entry | None:
    mode = found.st_mode
    if stat.S_ISLNK(mode):
        return Entry(path=path, kind=Kind.LINK, target=str(file.readlink()))
    if stat.S_ISDIR(mode):
        return Entry(path=path, kind=Kind.FOLDER)
    if stat.S_ISREG(mode):
        return Entry(path=path, kind=Kind.FILE, size=found.st_size, executable=bool(mode & stat.S_IXUSR))
    return None


def _odd(mode: int) -> str:
    what = "a socket" if stat.S_ISSOCK(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device"
    return f"it is {what}; put it into {ignore.FILE_NAME}, or remove it"


def _ignore_text(folder: Path) -> str:
    try:
        return (folder / ignore.FILE_NAME).read_text("utf-8")
    except FileNotFoundError:
        return ""
    except (OSError, UnicodeDecodeError) as error:
        raise BadArchiveError(f"{folder / ignore.FILE_NAME}: {error}") from error
