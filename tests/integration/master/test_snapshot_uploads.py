"""A snapshot that takes long to be sent, or waits long to be accepted, is kept as a whole."""

from __future__ import annotations

import asyncio
import hashlib
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.control_ends import SECRET
from support.engine import until
from websockets.asyncio.server import ServerConnection

from rce.aio.tasks import cancel_and_wait
from rce.control.exceptions import SnapshotError
from rce.control.messages import ToMaster, VolumeSaved
from rce.control.snapshots import UPLOADS, FileEntry, Manifest, Offer
from rce.control_channel.dialing import Dialer
from rce.control_channel.peer import Peer
from rce.control_channel.server import ControlServer
from rce.control_channel.uploads import Uploader
from rce.masters import Masters
from rce_master.leadership import Fence
from rce_master.leadership.core import LeadershipCore, LeaseSettings
from rce_master.packages.contents import ContentStore
from rce_master.snapshots import service
from rce_master.snapshots.service import SNAPSHOT, SPARED_S, SnapshotService
from rce_master.state.volume_records import UserVolume
from rce_master.state_service import StateService
from rce_master.store import MemoryStore

VOLUME = UserVolume(user="anna", name="v", size=1 << 20, process="c1", placement=1)
PIECE = b"what the only file holds"
PIECE_NAME = hashlib.sha256(PIECE).hexdigest()
FILE = FileEntry(
    path=b"file", mode=0o644, modified_ns=0, size=len(PIECE), pieces=(bytes.fromhex(PIECE_NAME),)
)
LISTED = Manifest(entries=(FILE,)).encode()
NAME = hashlib.sha256(LISTED).hexdigest()
OFFER = Offer(volume=VOLUME.id, contents=[NAME, PIECE_NAME])


class Kept:
    """A master, as far as snapshots are concerned."""

    def __init__(self, folder: Path, state_service: StateService, dialer: Dialer) -> None:
        self.folder = folder
        self.state_service = state_service
        self.service = SnapshotService(state_service, ContentStore(folder, noun=SNAPSHOT))
        self.dialer = dialer
        self.uploader = Uploader(dialer)
        self.socket: ServerConnection
        """The master's end of the newest connection."""

    @property
    def volume(self) -> UserVolume:
        return self.state_service.tables.volumes[VOLUME.id]

    def held(self) -> set[str]:
        return {path.name for path in self.folder.iterdir() if path.is_file()}

    def age(self) -> str:
        """Make all contents old, and add an old one that nothing needs; return its name."""
        unneeded = hashlib.sha256(b"unneeded").hexdigest()
        (self.folder / unneeded).touch()
        old = time.time() - SPARED_S - 100.0
        for name in self.held():
            os.utime(self.folder / name, (old, old))
        return unneeded

    def is_new(self, name: str) -> bool:
        return (self.folder / name).stat().st_mtime > time.time() - SPARED_S

    @asynccontextmanager
    async def sweeping(self) -> AsyncIterator[None]:
        running = asyncio.create_task(self.service.run())
        try:
            yield
        finally:
            await cancel_and_wait(running)

    async def sweep(self) -> None:
        """Remove old contents that are not needed."""
        unneeded = self.age()
        async with self.sweeping():
            await until(lambda: unneeded not in self.held(), what="a sweep")

    async def accept(self) -> None:
        await self.service.accept("c1", VolumeSaved(volume=VOLUME.id, placement=1, snapshot=NAME))


@pytest.fixture
async def kept(tmp_path: Path) -> AsyncIterator[Kept]:
    async def ignore(_: Peer, __: object = None) -> None:
        return

    async def ignore_message(_: Peer, __: ToMaster) -> None:
        return

    async def take(socket: ServerConnection) -> None:
        made.socket = socket
        await made.service.take(socket)

    state_service = await StateService.open(MemoryStore())
    state_service.tables.volumes.assign(VOLUME.id, VOLUME)
    server = ControlServer(
        SECRET, on_hello=ignore, on_message=ignore_message, on_gone=ignore, port=0, on_upload=take
    )
    async with server:
        dialer = Dialer(Masters([f"ws://127.0.0.1:{server.port}"]), SECRET)
        made = Kept(tmp_path / "snapshots", state_service, dialer)
        running = asyncio.create_task(state_service.run())
        try:
            yield made
        finally:
            await cancel_and_wait(running)


async def test_contents_stay_while_a_snapshot_is_sent(kept: Kept) -> None:
    async with kept.uploader.upload(OFFER) as upload:
        await upload.send(PIECE)
        await upload.finish()
        await kept.sweep()
        assert kept.held() == {PIECE_NAME}
        await upload.send(LISTED)
        await upload.finish()
    await until(lambda: kept.is_new(PIECE_NAME), what="the end of the connection is noted")
    await kept.accept()
    assert (kept.volume.snapshot, kept.volume.fault) == (NAME, "")


async def test_contents_stay_while_a_snapshot_waits_for_its_turn(kept: Kept) -> None:
    async with kept.uploader.upload(OFFER) as upload:
        await upload.send(PIECE)
        await upload.send(LISTED)
        await upload.finish()
    await until(lambda: not kept.service._coming, what="the end of the connection is noted")
    (kept.folder / "incoming").mkdir(exist_ok=True)
    await kept.service._lock.acquire()  # contents are being compared
    async with kept.sweeping():
        await until(lambda: not (kept.folder / "incoming").exists(), what="the sweep waits")
        accepting = asyncio.create_task(kept.accept())
        await until(lambda: kept.service._coming, what="the snapshot waits, behind the sweep")
        unneeded = kept.age()
        kept.service._lock.release()
        await accepting
        await until(lambda: unneeded not in kept.held(), what="the sweep")
    assert (kept.volume.snapshot, kept.volume.fault) == (NAME, "")
    assert kept.held() == {NAME, PIECE_NAME}


async def test_contents_of_a_broken_upload_go_after_a_while(kept: Kept) -> None:
    async with kept.uploader.upload(OFFER) as upload:
        await upload.send(PIECE)
        await upload.finish()
    await until(lambda: not kept.service._coming, what="the end of the connection is noted")
    await kept.sweep()
    assert kept.held() == set()


async def test_a_task_set_that_sends_nothing_more_is_given_up(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its contents would be spared for as long as it stays connected."""
    monkeypatch.setattr(service, "CONTENT_S", 0.1)

    async def send_late() -> None:
        async with kept.uploader.upload(OFFER) as upload:
            await kept.socket.wait_closed()
            await upload.send(PIECE)

    with pytest.raises(SnapshotError, match="it takes too long"):
        await send_late()


async def test_a_task_set_that_offers_nothing_is_given_up(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "OFFER_S", 0.1)
    async with kept.dialer.connect(UPLOADS, 1 << 20) as master, asyncio.timeout(60):
        await master.wait_closed()
        assert master.close_reason == "it takes too long"


async def test_a_master_without_the_lead_keeps_no_snapshot(kept: Kept) -> None:
    core = LeadershipCore(LeaseSettings(ttl=3.0))
    core.granted(0.0, 3.0)
    core.elected(1, 0.0)
    now = 1.0
    kept.service = SnapshotService(
        kept.state_service, ContentStore(kept.folder, noun=SNAPSHOT), fence=Fence(core, lambda: now, "one")
    )

    async def send() -> None:
        nonlocal now
        async with kept.uploader.upload(OFFER) as upload:
            now = 10.0
            await upload.send(PIECE)
            await upload.finish()

    with pytest.raises(SnapshotError, match="leads no more"):
        await send()
