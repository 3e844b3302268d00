"""Contents by their hash, in a folder: ``FOLDER/SHA256``, and ``FOLDER/incoming`` for running uploads.

They are archives of packages, or parts of snapshots of volumes.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import re
import shutil
import tempfile
import time
from itertools import count
from typing import TYPE_CHECKING

from rce.packages import DEFAULT_LIMITS, ArchiveLimits, BadArchiveError
from rce_master.exceptions import InvalidRequestError, StoreError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Collection
    from pathlib import Path

    from rce.packages.contents import Contents

ARCHIVES = "bundles"
"""Name of the folder in a master's state folder."""
ARCHIVES_PATH = "/archives"
"""Where a stand-by takes and gives them."""
_HASH = re.compile(r"[0-9a-f]{64}")
_INCOMING = "incoming"
_BUFFER = 1 << 20
_FULL = frozenset((errno.ENOSPC, errno.EDQUOT))


class Incoming:
    """A completely received archive."""

    def __init__(self, path: Path, limits: ArchiveLimits, sha256: str, size: int) -> None:
        self.path = path
        self.sha256 = sha256
        self.size = size
        """Bytes."""
        self._limits = limits

    async def inspect(self) -> Contents:
        """Return its contents.

        Raises:
            InvalidRequestError: It is not a package's archive.
        """
        try:
            return await asyncio.to_thread(self._inspect)
        except BadArchiveError as error:
            raise InvalidRequestError(f"the archive cannot be taken: {error}") from error

    def _inspect(self) -> Contents:
        from rce.packages.contents import inspect  # takes 1 MB, which engines without packages do not need

        with self.path.open("rb") as file:
            return inspect(file, self._limits)


class ContentStore:
    """The archives of all users. Archives with equal contents are stored once.

    Args:
        folder: Made with the first archive.
        limits: How large each may be.
        noun: What they are part of, for errors.

    Attributes:
        fault: Why the last archive was not kept, if the disk was full; empty if it was kept.
    """

    def __init__(
        self, folder: Path, limits: ArchiveLimits = DEFAULT_LIMITS, *, noun: str = "package"
    ) -> None:
        self._noun = noun
        self._folder = folder
        self._limits = limits
        self._numbers = count(1)
        self.fault = ""

    @contextlib.asynccontextmanager
    async def receive(self, chunks: AsyncIterator[bytes]) -> AsyncIterator[Incoming]:
        """Receive an archive; it is removed at the end unless it was kept.

        Raises:
            InvalidRequestError: The archive is too large.
            StoreError: It cannot be written.
        """
        try:
            path = await asyncio.to_thread(self._make_incoming)
            try:
                yield await self._write(path, chunks)
            finally:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise self._refused(error) from error

    async def keep(self, incoming: Incoming) -> None:
        """Keep an archive; when this returns, it survives a crash.

        Raises:
            StoreError: It cannot be kept.
        """
        try:
            await asyncio.to_thread(self._keep, incoming)
        except OSError as error:
            raise self._refused(error) from error
        self.fault = ""

    async def read(self, sha256: str, offset: int, length: int) -> tuple[bytes, int] | None:
        """Read a piece of an archive.

        Returns:
            The piece and the size of the archive; None if the archive does not exist.
        """
        if _HASH.fullmatch(sha256) is None:
            return None
        return await asyncio.to_thread(self._read, sha256, offset, length)

    def path(self, sha256: str) -> Path:
        """Return where an archive is, or would be."""
        return self._folder / sha256

    def held(self) -> set[str]:
        """Return the hashes of all archives. Blocks."""
        try:
            return {path.name for path in self._folder.iterdir() if _HASH.fullmatch(path.name)}
        except FileNotFoundError:
            return set()

    def sweep(self, known: Collection[str], spared: float = 0.0) -> None:
        """Remove all archives except those with known hashes. Blocks.

        Args:
            known: The hashes.
            spared: Keep also those that were written, or touched, within so many seconds.
        """
        newest = time.time() - spared
        with contextlib.suppress(FileNotFoundError):
            for path in self._folder.iterdir():
                if not _HASH.fullmatch(path.name) or path.name in known:
                    continue
                if not spared or path.stat().st_mtime <= newest:
                    path.unlink(missing_ok=True)

    def set_aside(self, sha256: str) -> Path:
        """Take an archive away, and return its file, which the caller removes. Does not block for long."""
        incoming = self._folder / _INCOMING
        incoming.mkdir(mode=0o700, exist_ok=True)
        return self.path(sha256).rename(incoming / f"{sha256}-{next(self._numbers)}")

    def touch(self, sha256: str) -> bool:
        """Return whether an archive exists, which :meth:`sweep` spares for a while then. Blocks."""
        if _HASH.fullmatch(sha256) is None:
            return False
        try:
            os.utime(self._folder / sha256)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def forget_incoming(self) -> None:
        """Remove unfinished uploads of an earlier master. Blocks."""
        shutil.rmtree(self._folder / _INCOMING, ignore_errors=True)

    def _refused(self, error: OSError) -> StoreError:
        text = f"the master cannot keep the {self._noun}: {error.strerror or error}"
        if error.errno in _FULL:
            self.fault = text
        return StoreError(text)

    def _make_incoming(self) -> Path:
        incoming = self._folder / _INCOMING
        incoming.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=incoming)
        os.close(descriptor)
        return incoming / name

    async def _write(self, path: Path, chunks: AsyncIterator[bytes]) -> Incoming:
        digest = hashlib.sha256()
        size = 0
        with path.open("wb") as file:
            held = bytearray()
            async for chunk in chunks:
                held += chunk
                size += len(chunk)
                if size > self._limits.archive:
                    raise InvalidRequestError(f"the archive has more than {self._limits.archive} bytes")
                if len(held) >= _BUFFER:
                    await asyncio.to_thread(_append, file.fileno(), digest.update, bytes(held))
                    held.clear()
            await asyncio.to_thread(_append, file.fileno(), digest.update, bytes(held))
            await asyncio.to_thread(os.fsync, file.fileno())
        return Incoming(path, self._limits, digest.hexdigest(), size)

    def _keep(self, incoming: Incoming) -> None:
        incoming.path.replace(self._folder / incoming.sha256)
        descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _read(self, sha256: str, offset: int, length: int) -> tuple[bytes, int] | None:
        try:
            descriptor = os.open(self._folder / sha256, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        try:
            return os.pread(descriptor, length, offset), os.fstat(descriptor).st_size
        finally:
            os.close(descriptor)


def _append(descriptor: int, update: Callable[[bytes], None], data: bytes) -> None:
    update(data)
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]
