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

from rce.aio.tasks import cancel_and_wait
from rce.control.messages import ToMaster, VolumeSaved
from rce.control.snapshots import FileEntry, Manifest, Offer
from rce.control_channel.dialing import Dialer
from rce.control_channel.peer import Peer
from rce.control_channel.server import ControlServer
from rce.control_channel.uploads import Uploader
from rce.masters import Masters
from rce_master.packages.contents import ContentStore
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

    def __init__(self, folder: Path, state_service: StateService, uploader: Uploader) -> None:
        self.folder = folder
        self.state_service = state_service
        self.service = SnapshotService(state_service, ContentStore(folder, noun=SNAPSHOT))
        self.uploader = uploader

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

    async def take(socket: object) -> None:
        await made.service.take(socket)  # type: ignore[arg-type]

    state_service = await StateService.open(MemoryStore())
    state_service.tables.volumes.assign(VOLUME.id, VOLUME)
    server = ControlServer(
        SECRET, on_hello=ignore, on_message=ignore_message, on_gone=ignore, port=0, on_upload=take
    )
    async with server:
        uploader = Uploader(Dialer(Masters([f"ws://127.0.0.1:{server.port}"]), SECRET))
        made = Kept(tmp_path / "snapshots", state_service, uploader)
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
    await kept.service._lock.acquire()  # another snapshot is copied to the other masters
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
