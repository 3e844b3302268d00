"""Takes snapshots of volumes from task sets, gives them back, and removes what no volume needs any more."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace
from websockets.exceptions import ConnectionClosed

from rce.aio.tasks import TaskScope
from rce.control import SnapshotError
from rce.control.snapshots import MAX_MANIFEST, Kept, Offer, Wanted, decode_manifest
from rce_master.exceptions import EndedError, FencedError, MasterError, StoreError
from rce_master.reports import REPEAT_S
from rce_master.snapshots.needed import NeededSnapshots
from rce_master.state import commands, volume_moves

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Collection, Coroutine, Iterator
    from contextlib import AbstractAsyncContextManager

    from websockets.asyncio.server import ServerConnection

    from rce.control import VolumeSaved
    from rce_master.leadership import Fence
    from rce_master.packages.contents import ContentStore
    from rce_master.packages.copies import ArchiveCopies
    from rce_master.state.changes import Changes
    from rce_master.state_service import StateService

_log = logging.getLogger(__name__)

SNAPSHOTS: Final = "snapshots"
"""Name of the folder in a master's state folder."""
SNAPSHOTS_PATH: Final = "/snapshots"
"""Where a stand-by takes and gives them."""
SNAPSHOT: Final = "snapshot"
SPARED_S = 900.0
"""Contents that no volume needs are kept for so long after the connection on which they were sent has ended:
the task set that sent them is about to report the snapshot that has them."""
OFFER_S = 30.0
"""Seconds that a task set may take to say what it has."""
CONTENT_S = 120.0
"""Seconds that it may take to send a content after the one before it, or to receive an answer."""
_SLACK = 16 << 20
"""Bytes that a snapshot may have beyond the size of its volume: sizes of folders are only watched."""
_SPREAD_AT_ONCE = 4
"""Snapshots that are sent to the other masters at the same time."""
_CLOSE_CODE = 1008


class SnapshotService:
    """The snapshots of all volumes.

    Args:
        state_service: Knows the volumes.
        store: Keeps the contents.
        clock: Seconds since 1970.
        copies: Those at other masters, if there may be any.
        fence: Tells whether this master leads, if there may be others.
    """

    def __init__(
        self,
        state_service: StateService,
        store: ContentStore,
        clock: Callable[[], float] = time.time,
        copies: ArchiveCopies | None = None,
        fence: Fence | None = None,
    ) -> None:
        self._fence = fence
        self._state_service = state_service
        self._store = store
        self._clock = clock
        self._copies = copies
        self._needed = NeededSnapshots(state_service.tables.volumes, store)
        self._coming: Counter[str] = Counter()
        """Contents of snapshots that are being sent, or wait for being accepted."""
        self._lock = asyncio.Lock()
        """Held while contents are compared with what the state needs."""
        self._spreading = asyncio.Semaphore(_SPREAD_AT_ONCE)
        self._dirty = asyncio.Event()
        state_service.listeners.append(self._note)

    async def run(self) -> None:
        """Remove contents that are not needed, and keep the other masters' complete, until cancelled.

        Raises:
            FencedError: This master leads no more.
        """
        if self._copies is None:
            await self._forget({known.snapshot for known in self._state_service.tables.volumes})
        async with TaskScope() as tasks:
            if self._copies is not None:
                tasks.spawn(self._copies.run(self._needed, self._forget), name="copies of snapshots")
            await self._sweep()

    async def _forget(self, contents: Collection[str]) -> None:
        """Forget snapshots with contents that no master has, as after a backup was restored.

        Args:
            contents: Those that no other master has.
        """
        missing = set(contents)
        for known in [one for one in self._state_service.tables.volumes if one.snapshot]:
            for sha256 in self._needed.contents_of(known.snapshot) & missing:
                if await asyncio.to_thread(self._is_lost, sha256):
                    lost = commands.SnapshotLost(volume=known.id, snapshot=known.snapshot)
                    await self._state_service.submit_all([lost])
                    break

    def _is_lost(self, sha256: str) -> bool:
        try:
            return not self._store.path(sha256).exists()
        except OSError as error:
            _log.error("it is not known whether the content %s is there: %s", sha256, error)
            return False

    async def _sweep(self) -> None:
        await asyncio.to_thread(self._store.forget_incoming)
        while True:
            self._dirty.clear()
            async with self._lock:
                await self._needed.look()
                if self._needed.is_complete():
                    known = self._needed.hashes() | self._coming.keys()
                    try:
                        await asyncio.to_thread(self._store.sweep, known, SPARED_S)
                    except OSError as error:
                        _log.error("snapshots that are needed no more stay on the disk: %s", error)
            if self._copies is not None:
                self._copies.look()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SPARED_S):
                    await self._dirty.wait()

    def _note(self, changes: Changes) -> None:
        if any(table == "volumes" for table, _ in changes.written()):
            self._dirty.set()

    # From and to task sets

    async def read(self, sha256: str, offset: int, count: int) -> tuple[bytes, int] | None:
        """Read a piece of a content for a task set; one that only another master has is fetched first.

        Returns:
            The piece and the size of the content; None if it does not exist.

        Raises:
            OSError: It cannot be read, or not yet.
        """
        found = await self._store.read(sha256, offset, count)
        if found is not None or self._copies is None or not await self._is_needed(sha256):
            return found
        await self._copies.obtain(sha256)
        return await self._store.read(sha256, offset, count)

    async def _is_needed(self, sha256: str) -> bool:
        if not self._needed.is_needed(sha256):
            await self._needed.look()
        return self._needed.is_needed(sha256)

    async def take(self, socket: ServerConnection) -> None:
        """Take the contents of a snapshot that a task set sends; return when it has hung up."""
        try:
            await self._take(socket)
        except ConnectionClosed:
            return
        except msgspec.MsgspecError as error:
            await socket.close(_CLOSE_CODE, f"not an offer: {error}"[:100])
        except TimeoutError:
            _log.warning("a snapshot from %s is given up: it takes too long", socket.remote_address)
            await socket.close(_CLOSE_CODE, "it takes too long")
        except FencedError as error:
            _log.info("a snapshot is not answered: %s", error)
            await socket.close(_CLOSE_CODE, str(error)[:100])

    async def _take(self, socket: ServerConnection) -> None:
        async with asyncio.timeout(OFFER_S):
            offer = msgspec.json.decode(await socket.recv(), type=Offer)
        known = self._state_service.tables.volumes.get(offer.volume)
        if known is None:
            await self._say(socket, Wanted(error=f"volume {offer.volume!r} does not exist"))
            return
        with self._sparing(offer.contents):
            answer = Wanted(contents=await asyncio.to_thread(self._missing, offer.contents))
            try:
                await self._say(socket, answer)
                await self._receive(socket, known.size)
            finally:
                # The task set has yet to report the snapshot: the contents are spared from now.
                with contextlib.suppress(OSError):
                    await asyncio.to_thread(self._missing, offer.contents)

    async def _say(self, socket: ServerConnection, answer: Wanted | Kept) -> None:
        """Send an answer, unless another master may lead by now."""
        if self._fence is not None:
            self._fence.check()
        async with asyncio.timeout(CONTENT_S):
            await socket.send(msgspec.json.encode(answer).decode())

    @contextlib.contextmanager
    def _sparing(self, contents: Collection[str]) -> Iterator[None]:
        """Keep contents that no volume needs yet, as long as the block takes."""
        self._coming.update(contents)
        try:
            yield
        finally:
            self._coming -= Counter(contents)

    def _missing(self, contents: list[str]) -> list[str]:
        return [sha256 for sha256 in contents if not self._store.touch(sha256)]

    async def _receive(self, socket: ServerConnection, most: int) -> None:
        left = most + _SLACK + MAX_MANIFEST
        while True:
            async with asyncio.timeout(CONTENT_S):
                data = await socket.recv()
            left -= len(data)
            kept = Kept()
            if isinstance(data, str) or left < 0:
                kept = Kept(error=f"it has more than the {most >> 20} MB that its volume may hold")
            else:
                try:
                    async with self._store.receive(_once(data)) as incoming:
                        await self._store.keep(incoming)
                except MasterError as error:
                    kept = Kept(error=str(error))
            await self._say(socket, kept)

    def accept(self, process: str, message: VolumeSaved) -> Coroutine[None, None, None]:
        """Note a snapshot that a task set has sent, once its contents are where they have to be.

        The move that it belongs to is the one under way at this call: another one may begin before the
        returned work is done.

        Args:
            process: Of the task set.
            message: What it says.

        Returns:
            The work.
        """
        taken = commands.SnapshotTaken(
            process=process,
            volume=message.volume,
            placement=message.placement,
            is_last=message.is_last,
            snapshot=message.snapshot,
            taken=self._clock(),
            since=volume_moves.phase_began(self._state_service.tables, message.volume),
            error=message.error,
        )
        return self._accept(taken)

    async def _accept(self, taken: commands.SnapshotTaken) -> None:
        try:
            if not taken.error:
                await self._keep(taken)
                return
        except (EndedError, FencedError):
            return  # the next leader is told again
        except (SnapshotError, StoreError) as error:
            taken = replace(taken, snapshot="", error=str(error))
        await self._note_end(taken)

    async def _note_end(self, taken: commands.SnapshotTaken) -> None:
        """Note a snapshot that failed; a container may wait for it. The store may fail for a while too."""
        while True:
            (outcome,) = await self._state_service.submit_all([taken])
            if outcome is None or isinstance(outcome, EndedError | FencedError):
                return
            if not isinstance(outcome, StoreError):
                _log.error("the end of a snapshot was not noted: %s", outcome)
                return
            await asyncio.sleep(REPEAT_S)

    async def _keep(self, taken: commands.SnapshotTaken) -> None:
        size, contents = await asyncio.to_thread(self._read_manifest, taken.snapshot)
        with self._sparing((taken.snapshot, *contents)):
            async with self._lock:
                await asyncio.to_thread(self._check, contents)
                self._needed.add(taken.snapshot, contents)
            async with self._spreading, self._spread(taken.snapshot, *contents):
                await self._state_service.submit(replace(taken, size=size))

    def _read_manifest(self, sha256: str) -> tuple[int, set[str]]:
        """Return the size and the contents of a snapshot. Blocks.

        Raises:
            SnapshotError: Its manifest is not there, or names what may not be made.
        """
        try:
            if not self._store.touch(sha256):
                raise SnapshotError("the master does not hold its list of files")
            manifest = decode_manifest(self._store.path(sha256).read_bytes())
        except OSError as error:
            raise SnapshotError(f"the master cannot read its list of files: {error.strerror}") from error
        return manifest.size, manifest.contents

    def _check(self, contents: set[str]) -> None:
        """Check that this master has all contents of a snapshot. Blocks.

        Raises:
            SnapshotError: It has not.
        """
        try:
            missing = self._missing(sorted(contents))
        except OSError as error:
            raise SnapshotError(f"the master cannot read its contents: {error.strerror}") from error
        if missing:
            raise SnapshotError(f"the master does not hold {len(missing)} of its contents")

    def _spread(self, *contents: str) -> AbstractAsyncContextManager[str]:
        return contextlib.nullcontext("") if self._copies is None else self._copies.spread(*contents)


async def _once(data: bytes) -> AsyncIterator[bytes]:
    yield data
