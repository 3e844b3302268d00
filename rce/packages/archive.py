"""The format of archives: ustar in gzip, with exactly one form for each tree.

An entry has no owner and no time, and of its mode only whether it may be executed, so equal folders make
equal archives. Any other archive is refused. The headers are read one by one, and not by
:class:`tarfile.TarFile`, which would trust the sizes in an archive's extended headers.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import tarfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import BinaryIO, Self

from rce.packages.exceptions import BadArchiveError
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits
from rce.packages.tree import Entry, Kind, Tree

_TYPES = {tarfile.REGTYPE: Kind.FILE, tarfile.DIRTYPE: Kind.FOLDER, tarfile.SYMTYPE: Kind.LINK}
_LETTERS = {kind: letter for letter, kind in _TYPES.items()}
_PLAIN, _EXECUTABLE, _LINK = 0o644, 0o755, 0o777
_BLOCK = tarfile.BLOCKSIZE
_END = bytes(2 * _BLOCK)
_CHUNK = 1 << 16
_LEVEL = 6


class ArchiveWriter:
    """Writes an archive. A context manager: the archive is complete when the block ends without an error."""

    def __init__(self, file: BinaryIO) -> None:
        self._gzip = gzip.GzipFile(filename="", mode="wb", compresslevel=_LEVEL, fileobj=file, mtime=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._gzip.write(_END)
        self._gzip.close()

    def add(self, entry: Entry, data: Iterable[bytes] = ()) -> None:
        """Add an entry.

        Raises:
            BadArchiveError: Its path does not fit into a header, or its data are not of its size.
        """
        self._gzip.write(make_header(entry))
        left = entry.size
        for chunk in data:
            left -= len(chunk)
            self._gzip.write(chunk)
        if left:
            raise BadArchiveError(f"{entry.path!r} changed while it was read")
        self._gzip.write(bytes(-entry.size % _BLOCK))


def make_header(entry: Entry) -> bytes:
    """Write an entry's header.

    Raises:
        BadArchiveError: Its path, or a link's target, does not fit in.
    """
    info = tarfile.TarInfo(entry.path)
    info.type = _LETTERS[entry.kind]
    info.mode = _mode(entry)
    info.size = entry.size
    info.linkname = entry.target
    try:
        return info.tobuf(tarfile.USTAR_FORMAT, "utf-8", "strict")
    except ValueError as error:
        raise BadArchiveError(
            f"{entry.path!r}: its path, or where it links to, is too long or no text"
        ) from error


def read_archive(
    file: BinaryIO,
    visit: Callable[[Entry, Iterator[bytes]], None],
    limits: ArchiveLimits = DEFAULT_LIMITS,
) -> tuple[Tree, str]:
    """Read an archive from its beginning.

    Args:
        file: A real file.
        visit: Called with each entry, in order, after the rules that can be checked so far, and with a
            file's data. Data that it does not read is skipped.
        limits: How large it may be.

    Returns:
        All entries, and the SHA-256, in hex, of what the archive unpacks to: however it was compressed, equal
        trees have the same one.

    Raises:
        BadArchiveError: It has another format, breaks a rule, or is too large; the text names the place.
    """
    stream = _Inflated(file, limits)
    tree = Tree(limits)
    while entry := _next(stream):
        tree.add(entry)
        data = stream.data(entry.size)
        visit(entry, data)
        for _ in data:
            pass
    stream.finish()
    tree.finish()
    return tree, stream.digest.hexdigest()


def _next(stream: _Inflated) -> Entry | None:
    header = stream.take(_BLOCK)
    if not any(header):
        return None
    try:
        info = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
    except (tarfile.HeaderError, ValueError) as error:
        raise BadArchiveError(f"it is not an archive of a package: {error}") from error
    kind = _TYPES.get(info.type)
    if kind is None:
        raise BadArchiveError(f"{info.name!r}: only files, folders and symbolic links may be in a package")
    entry = Entry(
        path=info.name,
        kind=kind,
        size=info.size if kind is Kind.FILE else 0,
        executable=kind is Kind.FILE and info.mode == _EXECUTABLE,
        target=info.linkname,
    )
    told = (info.mode, info.uid, info.gid, info.uname, info.gname, info.mtime, bool(info.linkname))
    if told != (_mode(entry), 0, 0, "", "", 0, kind is Kind.LINK) or info.size != max(0, entry.size):
        raise BadArchiveError(
            f"{info.name!r}: it has an owner, a time, a mode or a size that rce gives to none"
        )
    return entry


def _mode(entry: Entry) -> int:
    if entry.kind is Kind.LINK:
        return _LINK
    return _EXECUTABLE if entry.executable or entry.kind is Kind.FOLDER else _PLAIN


class _Inflated:
    """The contents of a compressed file, never more than the limits allow."""

    def __init__(self, file: BinaryIO, limits: ArchiveLimits) -> None:
        packed = os.fstat(file.fileno()).st_size
        if packed > limits.archive:
            raise BadArchiveError(f"the archive has more than {limits.archive} bytes")
        headers = (limits.entries + 2) * 2 * _BLOCK
        self._most = min(limits.unpacked + headers, max(limits.free, packed * limits.ratio))
        self._gzip = gzip.GzipFile(fileobj=file, mode="rb")
        self._taken = 0
        self.digest = hashlib.sha256()

    def take(self, count: int) -> bytes:
        """Take exactly so many bytes."""
        data = self._read(count)
        if len(data) != count:
            raise BadArchiveError("the archive ends too early")
        return data

    def data(self, size: int) -> Iterator[bytes]:
        """Take a file's data, and what fills its last block."""
        left = size
        while left:
            chunk = self.take(min(left, _CHUNK))
            left -= len(chunk)
            yield chunk
        if any(self.take(-size % _BLOCK)):
            raise BadArchiveError("there is something between two entries")

    def finish(self) -> None:
        """Take the end."""
        if any(self.take(_BLOCK)) or self._read(1):
            raise BadArchiveError("there is something behind the last entry")

    def _read(self, count: int) -> bytes:
        try:
            data = self._gzip.read(count)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise BadArchiveError(f"the archive is damaged: {error}") from error
        self._taken += len(data)
        if self._taken > self._most:
            raise BadArchiveError(f"it unpacks to more than {self._most} bytes")
        self.digest.update(data)
        return data
