"""One copy of each package on this machine, ``FOLDER/SHA256/NAME``, shared by the containers that need it.

A package is fetched, verified and unpacked in a scratch folder, and appears complete by one rename.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import re
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from rce.control import ContentError, PackageSpec
from rce.control_channel.contents import Piece
from rce.guard import CrowdedError, Turns
from rce.packages import DEFAULT_LIMITS, ArchiveError, ArchiveLimits, statement, verify
from rce_container.files import remove, size_of
from rce_container.packages.disk import Locks, forget_before_boot, in_thread, scratch_aside
from rce_container.packages.exceptions import FetchError, NoSpaceError, PackageTroubleError, VerificationError

Fetch = Callable[[str, int], Awaitable[Piece]]
"""Fetches a piece of a content by its hash and an offset; raises :class:`ContentError`."""

_HASH = re.compile(r"[0-9a-f]{64}")
_SCRATCH = "incoming"
_AT_ONCE = 8
_OF_ONE_USER = 2
_MAX_WAITING = 1024
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class PackageCache:
    """The packages of one machine.

    Args:
        folder: Belongs to this cache.
        fetch: Fetches from the master.
        space: Bytes; beyond it, the least recently used packages that no container holds are removed.
        limits: How large each may be.
    """

    def __init__(
        self, folder: Path, fetch: Fetch, *, space: int, limits: ArchiveLimits = DEFAULT_LIMITS
    ) -> None:
        self._folder = folder
        self._fetch = fetch
        self._space = space
        self._limits = limits
        self._sizes: dict[str, int] = {}
        """Bytes of each kept package, the least recently used first."""
        self._holders: defaultdict[str, set[str]] = defaultdict(set)
        self._locks = Locks()
        self._making_room = asyncio.Lock()
        self._turns = Turns(_AT_ONCE, waiting=_MAX_WAITING, each=_OF_ONE_USER)

    def open(self) -> None:
        """Find the kept packages, and remove unfinished ones. Blocks.

        Raises:
            OSError: The folder cannot be used.
        """
        forget_before_boot(self._folder)
        remove(self._folder / _SCRATCH)
        found = [path for path in self._folder.iterdir() if _HASH.fullmatch(path.name)]
        found.sort(key=lambda path: path.stat().st_mtime)
        self._sizes = {path.name: size_of(path) for path in found}

    def hold(self, holder: str, sha256s: set[str]) -> None:
        """Note which packages a container needs; they are not removed while it does."""
        for sha256 in [*self._holders]:
            self._holders[sha256].discard(holder)
            if not self._holders[sha256]:
                del self._holders[sha256]
        for sha256 in sha256s:
            self._holders[sha256].add(holder)

    async def ensure(self, user: str, package: PackageSpec) -> Path:
        """Provide a package. Concurrent callers cause one fetch.

        Args:
            user: The user who brought it.
            package: The package.

        Returns:
            The folder that holds the package's folder.

        Raises:
            PackageTroubleError: It is not available now.
            OSError: Another program changed the folder.
        """
        _check_signature(user, package)
        path = self._folder / package.sha256
        async with contextlib.AsyncExitStack() as stack:
            if not self._has(package, path):
                # Take the user's turn first: two users may want the same package, and neither waits for the
                # other's turn.
                await stack.enter_async_context(self._turn(user))
            await stack.enter_async_context(self._locks.of(package.sha256))
            if not self._has(package, path):
                await self._bring(package, path)
            self._sizes[package.sha256] = self._sizes.pop(package.sha256)
            await in_thread(os.utime, path)
        await self._make_room()
        return path

    def _has(self, package: PackageSpec, path: Path) -> bool:
        return package.sha256 in self._sizes and path.is_dir()

    @contextlib.asynccontextmanager
    async def _turn(self, user: str) -> AsyncIterator[None]:
        try:
            async with self._turns.turn(user):
                yield
        except CrowdedError:
            raise FetchError("too many packages are fetched to its machine just now") from None

    async def _bring(self, package: PackageSpec, path: Path) -> None:
        self._sizes.pop(package.sha256, None)
        try:
            async with scratch_aside(self._folder / _SCRATCH) as folder:
                archive = folder / "archive"
                await self._download(package, archive)
                tree = folder / "tree"
                size = await in_thread(self._unpack, package, archive, tree)
                await in_thread(_replace, tree, path)
        except OSError as error:
            raise trouble_of(error) from error
        self._sizes[package.sha256] = size

    async def _download(self, package: PackageSpec, archive: Path) -> None:
        digest = hashlib.sha256()
        offset, size = 0, 1
        with archive.open("wb") as file:
            while offset < size:
                try:
                    piece = await self._fetch(package.sha256, offset)
                except ContentError as error:
                    advice = "; push it again: rce package push" if error.missing else ""
                    raise FetchError(f"it cannot be fetched: {error}{advice}") from error
                size = piece.size
                offset += len(piece.data)
                if max(size, offset) > self._limits.archive:
                    raise VerificationError(f"it has more than {self._limits.archive} bytes")
                digest.update(piece.data)
                await in_thread(file.write, piece.data)
        if digest.hexdigest() != package.sha256:
            raise VerificationError(
                "what the master handed out is not what was signed; push it again: rce package push"
            )

    def _unpack(self, package: PackageSpec, archive: Path, tree: Path) -> int:
        from rce.packages.unpacking import unpack  # takes 1 MB, which engines without packages do not need

        tree.mkdir(mode=0o755)
        with archive.open("rb") as file:
            try:
                found, _ = unpack(file, tree, self._limits)
            except ArchiveError as error:
                raise VerificationError(f"its archive cannot be unpacked: {error}") from error
        if found.name != package.name:
            raise VerificationError(f"its archive holds the package {found.name!r}")
        return found.size

    async def _make_room(self) -> None:
        """Remove the least recently used packages that no container holds, until the rest fits."""
        async with self._making_room:
            for sha256 in list(self._sizes):
                if sum(self._sizes.values()) <= self._space:
                    return
                if sha256 not in self._holders and sha256 not in self._locks:
                    async with self._locks.of(sha256):  # one who asks for it meanwhile waits, and fetches it
                        self._sizes.pop(sha256, None)
                        await in_thread(remove, self._folder / sha256)


def trouble_of(error: OSError) -> PackageTroubleError:
    """Return a text for the owner about a disk error."""
    if error.errno in _FULL:
        return NoSpaceError("the disk of the container's machine is full; tell its operator")
    return NoSpaceError(
        f"the container's machine cannot keep it: {error.strerror or error}; tell its operator"
    )


def _check_signature(user: str, package: PackageSpec) -> None:
    signed = statement(user, package.name, package.version, package.sha256)
    try:
        verify(package.key, package.signature, signed)
    except ArchiveError as error:
        raise VerificationError(f"{error}; push it again: rce package push") from error


def _replace(tree: Path, path: Path) -> None:
    remove(path)
    tree.rename(path)
