"""A master that keeps snapshots of volumes, and orders to machines to save and restore one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from rce.control.messages import RestoreVolume, SaveVolume, ToMaster, VolumeRestored, VolumeSaved
from rce.control.model import VolumePlacement
from rce.control.snapshots import Offer
from rce.control_channel.contents import ContentClient
from rce.control_channel.dialing import Dialer
from rce.control_channel.peer import Peer
from rce.control_channel.server import ControlServer
from rce.control_channel.uploads import Upload, Uploader
from rce.masters import Masters
from rce.model import MEGABYTE, NodeSpec, Resources, Volume
from rce_container.volumes import images
from rce_master.packages.contents import ContentStore
from rce_master.snapshots.service import SNAPSHOT, SnapshotService
from rce_master.state.volume_records import UserVolume
from rce_master.state_service import StateService
from rce_master.store.memory import MemoryStore
from support.containers import Machine, until
from support.control_ends import SECRET

BOX = "user/box"
JOURNAL = "user/journal"
SIZE = 16 * MEGABYTE
IMAGES = pytest.mark.skipif(bool(why := images.unavailable()), reason=f"volumes cannot be images: {why}")


class Kept:
    """A master, as far as snapshots are concerned.

    Attributes:
        folder: Where it keeps them.
    """

    def __init__(self, folder: Path, state_service: StateService) -> None:
        self.folder = folder / "snapshots"
        self.service = SnapshotService(state_service, ContentStore(self.folder, noun=SNAPSHOT))
        state_service.tables.volumes.assign(
            JOURNAL, UserVolume(user="user", name="journal", size=SIZE, process="a", placement=1)
        )

    @property
    def held(self) -> set[str]:
        return {path.name for path in self.folder.iterdir() if path.is_file()}


@asynccontextmanager
async def keeping(folder: Path, *machines: Machine) -> AsyncIterator[Kept]:
    """Run a master that keeps snapshots, and let machines use it."""
    state_service = await StateService.open(MemoryStore())
    kept = Kept(folder, state_service)

    async def ignore(_: Peer, __: object = None) -> None:
        return

    async def ignore_message(_: Peer, __: ToMaster) -> None:
        return

    server = ControlServer(
        SECRET,
        on_hello=ignore,
        on_message=ignore_message,
        on_gone=ignore,
        port=0,
        contents=kept.service.read,
        on_upload=kept.service.take,
    )
    async with server:
        masters = Masters([f"ws://127.0.0.1:{server.port}"])
        for machine in machines:
            machine.uploader = Uploader(Dialer(masters, SECRET))
            machine.fetch_content = ContentClient(masters, SECRET).piece
        yield kept


def placement(number: int, *, is_new: bool = False) -> tuple[VolumePlacement, ...]:
    return (VolumePlacement(name="journal", number=number, is_new=is_new),)


async def put(
    machine: Machine, revision: int, number: int, *, snapshots: int = 0, is_new: bool = False, id_: str = BOX
) -> None:
    volume = Volume(name="journal", path="/data/journal", size=SIZE, snapshots=snapshots)
    await machine.put(
        id_,
        revision,
        nodes=(NodeSpec(tag="node", pkg="own", exe="keep.py"),),
        resources=Resources(volumes=(volume,)),
        volumes=placement(number, is_new=is_new),
    )


async def save(machine: Machine, number: int = 1) -> VolumeSaved:
    before = len(machine.of(VolumeSaved))
    await machine.manager.handle(SaveVolume(volume=JOURNAL, placement=number))
    await until(lambda: len(machine.of(VolumeSaved)) > before, what="it is saved")
    return machine.of(VolumeSaved)[-1]


async def restore(machine: Machine, snapshot: str, number: int = 2, size: int = SIZE) -> VolumeRestored:
    before = len(machine.of(VolumeRestored))
    order = RestoreVolume(volume=JOURNAL, placement=number, snapshot=snapshot, size=size)
    await machine.manager.handle(order)
    await until(lambda: len(machine.of(VolumeRestored)) > before, what="it is restored")
    return machine.of(VolumeRestored)[-1]


def files(machine: Machine) -> Path:
    return machine.folder / "state" / "volumes" / "user" / "journal"


class StuckUploader(Uploader):
    """Sends no snapshot of one volume to its end.

    Attributes:
        began: Set when it was to send one.
    """

    def __init__(self, dialer: Dialer) -> None:
        super().__init__(dialer)
        self.began = asyncio.Event()

    @asynccontextmanager
    async def upload(self, offer: Offer) -> AsyncIterator[Upload]:
        if offer.volume == JOURNAL:
            self.began.set()
            await asyncio.Event().wait()
        async with super().upload(offer) as upload:
            yield upload
