"""Saves volumes as snapshots at the master, and restores them: when they move, and now and then."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

from rce.aio.tasks import TaskScope
from rce.control import (
    ContentError,
    RestoreVolume,
    SaveVolume,
    SnapshotError,
    ToMaster,
    VolumeRestored,
    VolumeSaved,
)
from rce.control.snapshots import MAX_MANIFEST, Manifest, Offer, decode_manifest
from rce.guard.turns import CrowdedError, Turns
from rce_container.exceptions import VolumeError
from rce_container.files import remove
from rce_container.folder import make_accessible
from rce_container.packages.disk import in_own_thread, in_thread, make_in_thread
from rce_container.volumes import tree
from rce_container.volumes.freezing import frozen
from rce_container.volumes.tree import Allowance, Pieces

if TYPE_CHECKING:
    from rce.control_channel.contents import Piece
    from rce.control_channel.uploads import Uploader
    from rce_container.runtimes.base import Handle
    from rce_container.volumes.store import Claim, VolumeStore

_log = logging.getLogger(__name__)

FetchPiece: TypeAlias = "Callable[[str, int], Awaitable[Piece]]"
"""Fetches a piece of a content, by its hash and offset."""

_ATTEMPTS = 8
"""Of a transfer, while the master is away or another one takes its place."""
_PAUSE_S = 1.0
_AT_ONCE = 4
"""How many snapshots are taken at the same time, each of another user."""
_WAITING = 10_000
_RELEASE_S = 30.0
"""How long the container that has a volume may take to end completely."""
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_LOOK_S = 0.5
"""How often it is looked which volume's next snapshot is due."""


class Subject(Protocol):
    """A container, as far as its volumes are concerned."""

    @property
    def is_running(self) -> bool:
        """Whether its environment has reported and is not to end; before, its volumes may not be mounted."""

    @property
    def handle(self) -> Handle:
        """Its outermost process."""

    def pids(self) -> Iterable[int]:
        """All of its processes, as the machine sees them."""


class _Order(NamedTuple):
    """An order of the master that is being carried out."""

    message: SaveVolume | RestoreVolume
    task: asyncio.Task[None]


class SnapshotKeeper:
    """Saves and restores volumes.

    Args:
        store: The volumes.
        send: Sends a message to the master.
        spawn: Runs a task as long as the manager runs.
        release: Called with what :meth:`VolumeStore.hold` returned.
        uploader: Sends snapshots.
        fetch: Fetches a piece of a content, by its hash and offset.

    Attributes:
        is_wanted: Whether the master takes snapshots.
    """

    def __init__(
        self,
        store: VolumeStore,
        send: Callable[[ToMaster], None],
        spawn: Callable[..., asyncio.Task[None]],
        release: Callable[[str], None],
        *,
        uploader: Uploader,
        fetch: FetchPiece,
    ) -> None:
        self._store = store
        self._send = send
        self._spawn = spawn
        self._release = release
        self._uploader = uploader
        self._fetch = fetch
        self._orders: dict[str, _Order] = {}
        """The newest order for each volume; it may be done."""
        self._closed = False
        self._due: dict[tuple[str, str], float] = {}
        """When the next snapshot is taken, by incarnation and volume; seconds of the monotonic clock."""
        self._taken: set[tuple[str, str]] = set()
        """The snapshots that are being taken, by incarnation and volume."""
        self._turns = Turns(_AT_ONCE, waiting=_WAITING, each=1)
        self._copies: dict[tuple[str, str], Path] = {}
        """Copies of the last snapshots, by incarnation and volume: the next ones write only what differs."""
        self.is_wanted = False

    # Orders of the master

    def save(self, order: SaveVolume) -> None:
        """Send a volume whose container has ended; answers with ``VolumeSaved``."""
        self._begin(order, self._save(order))

    def restore(self, order: RestoreVolume) -> None:
        """Make a volume from a snapshot; answers with ``VolumeRestored``."""
        self._begin(order, self._restore(order))

    def withdraw(self, volumes: Iterable[str]) -> list[asyncio.Task[None]]:
        """Give up the orders for volumes, which are then not answered.

        Returns:
            Tasks that are ending; each holds its volume until it has ended.
        """
        orders = [self._orders.pop(id_) for id_ in volumes if id_ in self._orders]
        tasks = [order.task for order in orders if not order.task.done()]
        for task in tasks:
            task.cancel()
        return tasks

    async def close(self) -> None:
        """Give up all orders, and refuse those that come later."""
        self._closed = True
        if tasks := self.withdraw(list(self._orders)):
            await asyncio.wait(tasks)

    def _begin(self, message: SaveVolume | RestoreVolume, work: Coroutine[None, None, None]) -> None:
        former = self._orders.get(message.volume)
        is_repeated = former is not None and former.message == message and not former.task.done()
        if self._closed or is_repeated:  # an order that comes again is answered at the end of the first one
            work.close()
            return
        self.withdraw([message.volume])  # of an earlier move, which the master has given up
        task = self._spawn(work, name=f"{type(message).__name__} {message.volume}")
        self._orders[message.volume] = _Order(message, task)

    async def _save(self, order: SaveVolume) -> None:
        saved = VolumeSaved(volume=order.volume, placement=order.placement, is_last=True)
        try:
            snapshot = await self._save_held(order)
        except (SnapshotError, VolumeError, OSError) as error:
            _log.warning("volume %s is not saved: %s", order.volume, error)
            self._send(_with(saved, error=str(error)))
        else:
            self._send(_with(saved, snapshot=snapshot))

    async def _save_held(self, order: SaveVolume) -> str:
        async with self._held(order.volume):
            if self._store.places.placement(order.volume) < order.placement:
                raise SnapshotError("its files are not on this machine")
            root = await self._open(order.volume)
            try:
                return await self._send_tree(order.volume, root, _size_of(root))
            finally:
                os.close(root)

    async def _restore(self, order: RestoreVolume) -> None:
        error = ""
        try:
            # A repeated order must not undo what the container has written since.
            if not self._store.places.is_restored(order.volume, order.placement, order.snapshot):
                await self._restore_held(order)
        except (SnapshotError, VolumeError, OSError) as fault:
            error = str(fault)
            _log.warning("volume %s is not restored: %s", order.volume, error)
        self._send(VolumeRestored(volume=order.volume, placement=order.placement, error=error))

    async def _restore_held(self, order: RestoreVolume) -> None:
        async with self._held(order.volume):
            manifest = decode_manifest(await self._whole(order.snapshot, MAX_MANIFEST))
            new, root = await make_in_thread(lambda: self._store.places.make_new(order.size), _discard)
            try:
                try:
                    async with self._former(order.volume) as former:
                        await tree.write(manifest, root, lambda sha256: self._piece(sha256, former))
                finally:
                    os.close(root)
                await in_thread(self._store.replace, order.volume, new, order.placement, order.snapshot)
            finally:
                await in_thread(_remove, new)

    async def _open(self, id_: str) -> int:
        """Open a volume that no container has (:meth:`VolumePlaces.open`)."""
        return await make_in_thread(lambda: self._store.places.open(id_), os.close)

    @contextlib.asynccontextmanager
    async def _former(self, id_: str) -> AsyncIterator[Pieces | None]:
        """Open the files of an earlier placement, to use pieces of them again; None if there are none."""
        try:
            root = await self._open(id_)
        except VolumeError:
            yield None
            return
        try:
            pieces = None
            try:
                pieces = Pieces(root, await in_own_thread(tree.scan, root, _allowance(_size_of(root))))
            except (SnapshotError, OSError) as error:
                _log.info("former files of volume %s are of no use: %s", id_, error)
            yield pieces
        finally:
            os.close(root)

    async def _piece(self, sha256: str, former: Pieces | None) -> bytes:
        if former is not None and sha256 in former:
            with contextlib.suppress(SnapshotError, OSError):  # then it is fetched
                return await in_thread(former.read, sha256)
        return await self._whole(sha256, MAX_MANIFEST)

    async def _whole(self, sha256: str, most: int) -> bytes:
        """Fetch a content.

        Raises:
            SnapshotError: The master does not give it, or it is not what its hash says.
        """
        data = bytearray()
        failures = 0
        while True:
            try:
                piece = await self._fetch(sha256, len(data))
            except ContentError as error:
                failures += 1
                if error.missing or failures >= _ATTEMPTS:
                    raise SnapshotError(str(error)) from error
                await asyncio.sleep(_PAUSE_S)
                continue
            data += piece.data
            if len(data) >= piece.size or len(data) > most:
                break
        if hashlib.sha256(data).hexdigest() != sha256:
            raise SnapshotError(f"the content {sha256[:12]} is not what its hash says")
        return bytes(data)

    @contextlib.asynccontextmanager
    async def _held(self, id_: str) -> AsyncIterator[None]:
        """Keep containers from having a volume; wait until the one that has it has ended.

        Raises:
            VolumeError: It does not end.
        """
        deadline = time.monotonic() + _RELEASE_S
        while True:
            try:
                holder = self._store.hold(id_)
            except VolumeError:
                if time.monotonic() > deadline:
                    raise
                await asyncio.sleep(_LOOK_S)
            else:
                break
        try:
            yield
        finally:
            self._release(holder)

    # Sending

    async def _send_tree(self, id_: str, root: int, size: int) -> str:
        """Send a snapshot of a volume that may hold so many bytes; return its hash, in hex."""
        manifest = await in_own_thread(tree.scan, root, _allowance(size))
        listed = manifest.encode()
        name = hashlib.sha256(listed).hexdigest()
        failures = 0
        while True:
            try:
                await self._upload(id_, manifest, listed, name, root)
            except SnapshotError as error:
                failures += 1
                if not error.is_temporary or failures >= _ATTEMPTS:
                    raise
                await asyncio.sleep(_PAUSE_S)
            else:
                return name

    async def _upload(self, id_: str, manifest: Manifest, listed: bytes, name: str, root: int) -> None:
        pieces = Pieces(root, manifest)
        offer = Offer(volume=id_, contents=[name, *sorted(manifest.contents)])
        async with self._uploader.upload(offer) as upload:
            for sha256 in sorted(upload.wanted & manifest.contents):
                await upload.send(await in_thread(pieces.read, sha256))
            if name in upload.wanted:
                await upload.send(listed)
            await upload.finish()

    # Snapshots of running containers

    async def run(self, subjects: Mapping[str, Subject]) -> None:
        """Take the snapshots that volumes ask for, until cancelled.

        Users take turns, so that a large volume of one delays others' snapshots only a little.

        Args:
            subjects: The containers, by incarnation; the time of those that start or end does not count.
        """
        async with TaskScope() as tasks:
            await self._run(subjects, tasks)

    async def _run(self, subjects: Mapping[str, Subject], tasks: TaskScope) -> None:
        while True:
            await asyncio.sleep(_LOOK_S)
            asked = {
                (incarnation_id, claim.id): claim
                for incarnation_id, subject in subjects.items()
                if subject.is_running
                for claim in self._store.claims(incarnation_id)
                if claim.snapshots
            }
            now = time.monotonic()
            self._due = {key: self._due.get(key, now + claim.snapshots) for key, claim in asked.items()}
            for key in self._copies.keys() - asked.keys() - self._taken:
                await asyncio.to_thread(_remove, self._copies.pop(key))
            for key, claim in asked.items():
                subject = subjects.get(key[0])
                if subject is None or key in self._taken or self._due[key] > now or not self.is_wanted:
                    continue
                self._due[key] = now + claim.snapshots
                self._taken.add(key)
                tasks.spawn(self._take_in_turn(key, subject, claim), name=f"snapshot of {claim.id}")

    async def _take_in_turn(self, key: tuple[str, str], subject: Subject, claim: Claim) -> None:
        try:
            async with self._turns.turn(claim.id.partition("/")[0], claim.id):
                if subject.is_running:
                    await self._take(key, subject, claim)
        except CrowdedError:
            _log.warning("there is no snapshot of volume %s: too many others wait", claim.id)
        finally:
            self._taken.discard(key)

    async def _take(self, key: tuple[str, str], subject: Subject, claim: Claim) -> None:
        saved = VolumeSaved(volume=claim.id, placement=claim.placement)
        try:
            if key not in self._copies:
                self._copies[key] = await asyncio.to_thread(self._store.places.make_scratch)
            pause = await in_own_thread(self._copy, subject, claim, self._copies[key])
            _log.debug("volume %s: its container was stopped for %.1f ms", claim.id, 1e3 * pause)
            root = os.open(self._copies[key], _FOLDER)
            try:
                size = claim.size or _size_of(root)
                saved = _with(saved, snapshot=await self._send_tree(claim.id, root, size))
            finally:
                os.close(root)
        except (SnapshotError, VolumeError, OSError) as error:
            if not subject.is_running:
                _log.info("volume %s: its container ended before its snapshot was complete", claim.id)
                return
            _log.warning("there is no snapshot of volume %s: %s", claim.id, error)
            saved = _with(saved, error=str(error))
        self._send(saved)

    def _copy(self, subject: Subject, claim: Claim, scratch: Path) -> float:
        """Copy a volume twice: while it is used, and what changed, while its container is stopped. Blocks.

        Returns:
            For how many seconds it was stopped.
        """
        root = self._store.places.open_running(claim.id, subject.handle.namespaces_pid, claim.path)
        target = os.open(scratch, _FOLDER)
        size = claim.size or _size_of(root)

        def is_wanted() -> bool:  # its file system stays mounted while it is read
            return subject.is_running

        try:
            with contextlib.suppress(SnapshotError, OSError):  # files vanish meanwhile; the next copy counts
                tree.copy(root, target, Allowance(size, is_wanted))
            if not is_wanted():
                raise SnapshotError("its container ended while it was read")
            with frozen(subject.pids):
                began = time.perf_counter()
                copied = tree.copy(root, target, Allowance(size, is_wanted))
                if not is_wanted():  # what came after it may have written meanwhile
                    raise SnapshotError("its container ended while it was copied")
                pause = time.perf_counter() - began
            tree.finish_copy(copied, target)
            return pause
        finally:
            os.close(root)
            os.close(target)


def _with(saved: VolumeSaved, *, snapshot: str = "", error: str = "") -> VolumeSaved:
    return VolumeSaved(
        volume=saved.volume,
        placement=saved.placement,
        is_last=saved.is_last,
        snapshot=snapshot,
        error=error,
    )


def _allowance(size: int) -> Allowance:
    """Let the present task read a volume until it is cancelled: the thread that reads ends soon then."""
    task = asyncio.current_task()
    assert task is not None
    return Allowance(size, lambda: not task.cancelling())


def _size_of(root: int) -> int:
    """Return how many bytes the file system of a folder can hold."""
    found = os.fstatvfs(root)
    return found.f_blocks * found.f_frsize


def _discard(made: tuple[Path, int]) -> None:
    """Close and remove a volume that was just made. Blocks."""
    new, root = made
    os.close(root)
    _remove(new)


def _remove(path: Path) -> None:
    """Remove a folder or an image that is not needed any more. Blocks."""
    if path.suffix == ".img":
        path.unlink(missing_ok=True)
    elif path.exists():
        make_accessible(path)
        remove(path)
