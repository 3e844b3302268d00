"""Folders that appear atomically. Functions that are not asynchronous block."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import tempfile
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from rce_container.files import remove

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

P = ParamSpec("P")
R = TypeVar("R")

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_READ_ONLY_FOLDER = 0o755


@contextlib.contextmanager
def scratch(parent: Path) -> Iterator[Path]:
    """Make a private folder, and remove it in the end."""
    folder = _make_scratch(parent)
    try:
        yield folder
    finally:
        remove(folder)


def _make_scratch(parent: Path) -> Path:
    parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(dir=parent))


async def in_thread(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Run a blocking function; a cancelled caller still waits for its end.

    So no caller removes a folder into which a thread still writes.
    """
    return await _await_end(asyncio.ensure_future(asyncio.to_thread(function, *args, **kwargs)))


async def in_own_thread(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Do the same as :func:`in_thread` for what may take minutes: the shared threads are few."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="long work")
    work = asyncio.get_running_loop().run_in_executor(pool, partial(function, *args, **kwargs))
    pool.shutdown(wait=False)
    return await _await_end(work)


async def make_in_thread(make: Callable[[], R], undo: Callable[[R], object]) -> R:
    """Do the same as :func:`in_thread` for what has to be closed or removed.

    Args:
        make: Blocks.
        undo: Is called with the result if the caller was cancelled meanwhile. Quick.
    """
    work = asyncio.ensure_future(asyncio.to_thread(make))
    try:
        return await _await_end(work)
    except asyncio.CancelledError:
        if not work.cancelled() and work.exception() is None:
            undo(work.result())
        raise


async def _await_end(work: asyncio.Future[R]) -> R:
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        while not work.done():
            with contextlib.suppress(asyncio.CancelledError):  # one more does not end the thread either
                await asyncio.wait([work])
        if not work.cancelled():
            work.exception()  # noted as seen: a thread that was told to stop may say so
        raise


@contextlib.asynccontextmanager
async def scratch_aside(parent: Path) -> AsyncIterator[Path]:
    """Do the same as :func:`scratch`, in a thread."""
    folder = await in_thread(_make_scratch, parent)
    try:
        yield folder
    finally:
        await in_thread(remove, folder)


def forget_before_boot(folder: Path) -> None:
    """Empty a folder that was filled before the machine was started.

    Its files were not synced to the disk, so it may be incomplete after a power failure.
    """
    note = folder / "boot"
    try:
        now = BOOT_ID.read_text()
    except OSError:
        now = ""
    with contextlib.suppress(OSError):
        if now and note.read_text() == now:
            return
    for path in list(folder.iterdir()) if folder.is_dir() else []:
        remove(path)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    note.write_text(now)


def replicate(source: Path, target: Path, *, link: bool) -> None:
    """Copy a tree, with hard links where possible.

    Args:
        source: A tree of folders, files and links.
        target: Is made.
        link: Whether hard links may be used, because the receiver cannot write to the files.

    Raises:
        OSError: The tree cannot be made.
    """
    target.mkdir()
    target.chmod(_READ_ONLY_FOLDER)
    with os.scandir(source) as entries:
        for entry in entries:
            made = target / entry.name
            if entry.is_symlink():
                made.symlink_to(os.readlink(entry.path))  # noqa: PTH115 - as it is
            elif entry.is_dir(follow_symlinks=False):
                replicate(Path(entry.path), made, link=link)
            elif not link or not _linked(entry.path, made):
                shutil.copy2(entry.path, made)


def _linked(source: str, target: Path) -> bool:
    try:
        target.hardlink_to(source)
    except OSError:
        return False  # another disk, or too many links: a copy does it
    return True


class Locks:
    """A lock for each key."""

    def __init__(self) -> None:
        self._locks: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._busy: Counter[str] = Counter()
        """How many tasks hold or wait for each lock."""

    def __contains__(self, key: str) -> bool:
        """Return whether a task holds or waits for a lock."""
        return key in self._busy

    @contextlib.asynccontextmanager
    async def of(self, key: str) -> AsyncIterator[None]:
        """Hold the lock of a key."""
        self._busy[key] += 1
        try:
            async with self._locks[key]:
                yield
        finally:
            self._busy[key] -= 1
            if not self._busy[key]:
                del self._busy[key], self._locks[key]
