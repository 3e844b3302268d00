"""Volumes go from one machine to another over a real master's port: saved, restored, and refused."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.containers import Machine, until
from support.control_ends import SECRET
from websockets.asyncio.server import ServerConnection, serve

from rce.control.messages import (
    CONTROL_VERSION,
    SNAPSHOTS,
    RemoveVolume,
    RestoreVolume,
    SaveVolume,
    ToMaster,
    VolumeLimit,
    VolumeRemoved,
    VolumeRestored,
    VolumeSaved,
    Welcome,
)
from rce.control.model import VolumePlacement
from rce.control.snapshots import Offer, decode_manifest, digest
from rce.control_channel.connections import OpenConnections
from rce.control_channel.contents import ContentClient, Piece
from rce.control_channel.dialing import Dialer
from rce.control_channel.peer import Peer
from rce.control_channel.server import ControlServer
from rce.control_channel.uploads import Upload, Uploader
from rce.masters import Masters
from rce.model import MEGABYTE, NodeSpec, Resources, Volume
from rce_container.volumes import images, snapshots, tree
from rce_container.volumes.places import VolumePlaces
from rce_container.volumes.store import VolumeStore
from rce_master.packages.contents import ContentStore
from rce_master.snapshots.service import SNAPSHOT, SnapshotService
from rce_master.state.volume_records import UserVolume
from rce_master.state_service import StateService
from rce_master.store.memory import MemoryStore

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


@pytest.fixture
def pair(folder: Path) -> Iterator[tuple[Machine, Machine]]:
    """Two machines whose volumes are folders."""
    machines = (Machine(folder / "a", "process"), Machine(folder / "b", "process"))
    yield machines
    for machine in machines:
        machine.tidy()


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


async def check_move(a: Machine, b: Machine, folder: Path) -> None:
    """A volume goes from one machine to the other and back; each has what the one before wrote."""
    async with keeping(folder, a, b), a.engine(), b.engine():
        await put(a, 1, 1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await a.drop(BOX)
        saved = await save(a)
        assert (saved.error, saved.is_last) == ("", True)
        assert (await restore(b, saved.snapshot)).error == ""
        await put(b, 1, 2)
        await b.log_holds(BOX, "node", "2 runs")
        await b.drop(BOX)
        saved = await save(b, 2)
        assert (await restore(a, saved.snapshot, 3)).error == ""
        for machine in (a, b):
            for made in (machine.folder / "state" / "volumes").glob("**/"):
                assert made.stat().st_mode & 0o077 == 0, f"others can look into {made}"
        await put(a, 300, 3)
        await a.log_holds(BOX, "node", "3 runs")
        await a.drop(BOX, 400)


async def test_folders_move(pair: tuple[Machine, Machine], folder: Path) -> None:
    await check_move(*pair, folder)


@pytest.mark.needs("bwrap")
@IMAGES
async def test_images_and_folders_move_to_one_another(folder: Path) -> None:
    machines = Machine(folder / "a", "namespace"), Machine(folder / "b", "namespace")
    machines[0].volume_limit = VolumeLimit.IMAGE
    try:
        await check_move(*machines, folder)
    finally:
        for machine in machines:
            machine.tidy()


async def test_only_what_is_missing_is_sent(pair: tuple[Machine, Machine], folder: Path) -> None:
    a, b = pair
    async with keeping(folder, a, b) as kept, a.engine(), b.engine():
        files(a).mkdir(parents=True)
        (files(a) / "large").write_bytes(os.urandom(4 * MEGABYTE))
        await put(a, 1, 1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await a.drop(BOX)
        first = await save(a)
        before = kept.held
        (files(a) / "small").write_text("more")
        second = await save(a)
        assert len(kept.held - before) == 2, "the list and the new file"
        await restore(b, first.snapshot)
        for name in before:
            (kept.folder / name).unlink()  # what it has need not be fetched
        assert (await restore(b, second.snapshot, 3)).error == ""
        assert (files(b) / "small").read_text() == "more"
        assert (files(b) / "large").read_bytes() == (files(a) / "large").read_bytes()


@pytest.mark.parametrize(
    ("runtime", "limit"),
    [
        ("process", VolumeLimit.WATCHED),
        pytest.param("namespace", VolumeLimit.WATCHED, marks=pytest.mark.needs("bwrap")),
        pytest.param("namespace", VolumeLimit.IMAGE, marks=[pytest.mark.needs("bwrap"), IMAGES]),
    ],
)
async def test_a_running_volume_is_saved_again_and_again(
    folder: Path, runtime: str, limit: VolumeLimit
) -> None:
    a, b = (Machine(folder / name, runtime) for name in "ab")
    a.volume_limit = b.volume_limit = limit
    try:
        await check_snapshots(a, b, folder)
    finally:
        for machine in (a, b):
            machine.tidy()


async def check_snapshots(a: Machine, b: Machine, folder: Path) -> None:
    """A snapshot of a running container is what another one starts with."""
    async with keeping(folder, a, b), a.engine(), b.engine():
        await a.manager.handle(Welcome(version=CONTROL_VERSION, master="m", features=(SNAPSHOTS,)))
        await put(a, 1, 1, snapshots=1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await until(lambda: len(a.of(VolumeSaved)) > 1, what="two snapshots")
        saved = a.of(VolumeSaved)[-1]
        assert (saved.is_last, saved.placement, saved.error) == (False, 1, "")
        assert (await restore(b, saved.snapshot)).error == ""
        await put(b, 1, 2)
        await b.log_holds(BOX, "node", "2 runs")
        await a.drop(BOX)
        scratch = files(a).parents[1] / ".scratch"
        await until(lambda: not list(scratch.iterdir()), what="the copy is removed with its container")


@pytest.mark.needs("bwrap")
@IMAGES
async def test_a_container_that_starts_gives_no_snapshot(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before its volume is mounted, an empty folder is in its place."""
    prepare = VolumeStore.prepare

    def prepare_slowly(store: VolumeStore, incarnation_id: str) -> None:
        time.sleep(3)
        prepare(store, incarnation_id)

    monkeypatch.setattr(VolumeStore, "prepare", prepare_slowly)
    machine = Machine(folder, "namespace")
    machine.volume_limit = VolumeLimit.IMAGE
    try:
        async with keeping(folder, machine) as kept, machine.engine():
            await machine.manager.handle(Welcome(version=CONTROL_VERSION, master="m", features=(SNAPSHOTS,)))
            await put(machine, 1, 1, snapshots=1, is_new=True)
            await until(lambda: machine.of(VolumeSaved), what="a snapshot")
            first = machine.of(VolumeSaved)[0]
            assert first.error == ""
            manifest = decode_manifest((kept.folder / first.snapshot).read_bytes())
            assert [entry.path for entry in manifest.entries] == [b"log"]
            await machine.drop(BOX)
    finally:
        machine.tidy()


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


async def test_a_slow_snapshot_does_not_delay_other_users(
    pair: tuple[Machine, Machine], folder: Path
) -> None:
    a, _ = pair
    async with keeping(folder, a), contextlib.AsyncExitStack() as stack:
        assert a.uploader is not None
        a.uploader = StuckUploader(a.uploader._dialer)
        await stack.enter_async_context(a.engine())
        await a.manager.handle(Welcome(version=CONTROL_VERSION, master="m", features=(SNAPSHOTS,)))
        for id_ in (BOX, "other/box"):
            await put(a, 1, 1, snapshots=1, is_new=True, id_=id_)
            await a.log_holds(id_, "node", "1 runs")
        await until(lambda: len(a.of(VolumeSaved)) > 1, what="two snapshots")
        assert {saved.volume for saved in a.of(VolumeSaved)} == {"other/journal"}
        await a.drop(BOX)
        await a.drop("other/box")


async def test_volume_is_sent_to_the_next_leader_when_one_hangs(
    pair: tuple[Machine, Machine], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next leader repeats its order, which changes nothing while the first one is carried out."""
    monkeypatch.setattr("rce.control_channel.uploads.ANSWER_S", 3600.0)
    a, _ = pair
    asked, connections = asyncio.Event(), OpenConnections()

    async def hang(socket: ServerConnection) -> None:
        await socket.recv()
        asked.set()
        await socket.wait_closed()

    async with keeping(folder, a), serve(hang, "127.0.0.1", 0, ping_interval=None) as hanging:
        assert a.uploader is not None
        leader = a.uploader._dialer._masters.current
        former = f"ws://127.0.0.1:{hanging.sockets[0].getsockname()[1]}"
        masters = Masters([former, leader])
        a.uploader = Uploader(Dialer(masters, SECRET, connections=connections))
        async with a.engine():
            files(a).mkdir(parents=True)
            order = SaveVolume(volume=JOURNAL, placement=0)
            await a.manager.handle(order)
            await asked.wait()
            masters.failed(former)
            connections.note_leader(leader)
            await a.manager.handle(order)
            await until(lambda: a.of(VolumeSaved), what="it is saved")
        assert [saved.error for saved in a.of(VolumeSaved)] == [""]


async def saved_by(machine: Machine) -> str:
    """Let a machine save a file; return the snapshot."""
    files(machine).mkdir(parents=True)
    (files(machine) / "log").write_text("saved")
    saved = await save(machine, 0)
    assert saved.error == ""
    return saved.snapshot


@pytest.mark.parametrize("number", [2, 5])
async def test_files_of_an_abandoned_state_are_replaced(
    pair: tuple[Machine, Machine], folder: Path, number: int
) -> None:
    """A master whose state was restored from a backup counts placements from an earlier one again."""
    a, b = pair
    async with keeping(folder, a, b), a.engine(), b.engine():
        snapshot = await saved_by(a)
        files(b).mkdir(parents=True)
        (files(b) / "log").write_text("abandoned")
        VolumePlaces(files(b).parents[1], images=False).note_placement(JOURNAL, number)
        assert (await restore(b, snapshot)).error == ""
        assert (files(b) / "log").read_text() == "saved"
        (files(a) / "log").write_text("saved again")
        assert (await restore(b, (await save(a, 0)).snapshot)).error == ""
        assert (files(b) / "log").read_text() == "saved again"


async def test_repeated_order_keeps_what_was_written_since(
    pair: tuple[Machine, Machine], folder: Path
) -> None:
    a, b = pair
    async with keeping(folder, a, b), a.engine(), b.engine():
        snapshot = await saved_by(a)
        assert (await restore(b, snapshot)).error == ""
        (files(b) / "log").write_text("newer")
        assert (await restore(b, snapshot)).error == ""
        assert (files(b) / "log").read_text() == "newer"


async def test_volume_of_running_container_is_not_replaced(
    pair: tuple[Machine, Machine], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "_RELEASE_S", 0.1)
    a, b = pair
    async with keeping(folder, a, b), a.engine(), b.engine():
        snapshot = await saved_by(a)
        await put(b, 1, 2, is_new=True)
        await b.log_holds(BOX, "node", "1 runs")
        assert "has not ended" in (await restore(b, snapshot)).error
        assert (files(b) / "log").read_text() != "saved"
        await b.drop(BOX)


async def test_damage_is_refused_and_changes_nothing(pair: tuple[Machine, Machine], folder: Path) -> None:
    a, b = pair
    async with keeping(folder, a, b) as kept, a.engine(), b.engine():
        await put(a, 1, 1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await a.drop(BOX)
        assert "not on this machine" in (await save(a, 2)).error
        saved = await save(a)
        assert (await restore(b, saved.snapshot)).error == ""
        was = (files(b) / "log").read_text()
        (piece,) = kept.held - {saved.snapshot}
        shutil.rmtree(files(b))
        files(b).mkdir()
        (files(b) / "log").write_text("former")
        (kept.folder / piece).write_text("damage")
        assert "is not what its hash says" in (await restore(b, saved.snapshot, 3)).error
        (kept.folder / piece).unlink()
        assert "does not have it" in (await restore(b, saved.snapshot, 3)).error
        assert (files(b) / "log").read_text() == "former"
        (kept.folder / piece).write_text(was)
        assert (await restore(b, saved.snapshot, 3)).error == ""
        assert (files(b) / "log").read_text() == was
        await put(a, 200, 4)
        await until(
            lambda: any("are not on this machine any more" in text for text in a.faults), what="a refusal"
        )


async def test_a_master_that_has_no_room_refuses(pair: tuple[Machine, Machine], folder: Path) -> None:
    a, b = pair
    async with keeping(folder, a, b) as kept, a.engine():
        await put(a, 1, 1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await a.drop(BOX)
        (files(a) / "large").write_bytes(os.urandom(4 * SIZE + 8 * MEGABYTE))
        assert "that its volume may hold" in (await save(a)).error
        (files(a) / "large").unlink()
        shutil.rmtree(kept.folder)
        kept.folder.write_text("no folder")
        assert "cannot keep the snapshot" in (await save(a)).error


class StuckFetch:
    """A master that gives no content.

    Attributes:
        began: Set when it was asked for one.
    """

    def __init__(self) -> None:
        self.began = asyncio.Event()

    async def __call__(self, sha256: str, offset: int) -> Piece:
        self.began.set()
        await asyncio.Event().wait()
        raise AssertionError


@pytest.mark.parametrize(
    ("runtime", "limit"),
    [
        ("process", VolumeLimit.WATCHED),
        pytest.param("namespace", VolumeLimit.IMAGE, marks=[pytest.mark.needs("bwrap"), IMAGES]),
    ],
)
async def test_a_container_called_back_starts_during_its_save(
    folder: Path, runtime: str, limit: VolumeLimit
) -> None:
    """The master gave the move up; the snapshot would be for nothing, and may take hours."""
    a = Machine(folder / "a", runtime)
    a.volume_limit = limit
    try:
        async with keeping(folder, a), contextlib.AsyncExitStack() as stack:
            assert a.uploader is not None
            a.uploader = stuck = StuckUploader(a.uploader._dialer)
            await stack.enter_async_context(a.engine())
            await put(a, 1, 1, is_new=True)
            await a.log_holds(BOX, "node", "1 runs")
            await a.drop(BOX)
            await a.manager.handle(SaveVolume(volume=JOURNAL, placement=1))
            await stuck.began.wait()
            await put(a, 200, 1)
            await a.log_holds(BOX, "node", "2 runs")
            assert (a.faults, a.of(VolumeSaved)) == ([], [])
            await a.drop(BOX, 300)
    finally:
        a.tidy()


async def test_a_container_called_back_ends_the_scan(
    pair: tuple[Machine, Machine], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that reads the volume does not read it to its end."""
    a, _ = pair
    began, go_on, read = threading.Event(), threading.Event(), []

    def digest_when_told(data: bytes) -> bytes:
        read.append(len(data))
        began.set()
        go_on.wait(60)
        return digest(data)

    monkeypatch.setattr(tree, "digest", digest_when_told)
    async with keeping(folder, a), a.engine():
        files(a).mkdir(parents=True)
        (files(a) / "large").write_bytes(os.urandom(4 * MEGABYTE))
        await put(a, 1, 1, is_new=True)
        await a.log_holds(BOX, "node", "1 runs")
        await a.drop(BOX)
        await a.manager.handle(SaveVolume(volume=JOURNAL, placement=1))
        await until(began.is_set, what="it is read")
        await put(a, 200, 1)
        go_on.set()
        await a.log_holds(BOX, "node", "2 runs")
        assert len(read) == 1
        await a.drop(BOX, 300)


async def test_a_newer_order_takes_the_place_of_an_older_one(
    pair: tuple[Machine, Machine], folder: Path
) -> None:
    """The older one is of a move that was given up; its time may not be over for hours."""
    a, _ = pair
    async with keeping(folder, a), contextlib.AsyncExitStack() as stack:
        assert a.uploader is not None
        a.uploader = stuck = StuckUploader(a.uploader._dialer)
        await stack.enter_async_context(a.engine())
        files(a).mkdir(parents=True)
        a.manager._volumes.places.note_placement(JOURNAL, 1)
        await a.manager.handle(SaveVolume(volume=JOURNAL, placement=1))
        await stuck.began.wait()
        saved = await save(a, 2)
        assert (saved.placement, saved.error) == (2, "its files are not on this machine")


async def test_a_volume_being_restored_can_be_removed(pair: tuple[Machine, Machine], folder: Path) -> None:
    _, b = pair
    async with keeping(folder, b), contextlib.AsyncExitStack() as stack:
        b.fetch_content = stuck = StuckFetch()
        await stack.enter_async_context(b.engine())
        order = RestoreVolume(volume=JOURNAL, placement=2, snapshot="0" * 64, size=SIZE)
        await b.manager.handle(order)
        await stuck.began.wait()
        await b.manager.handle(RemoveVolume(volume=JOURNAL))
        await until(lambda: b.of(VolumeRemoved), what="it is removed")
        assert b.of(VolumeRestored) == []


async def test_a_manager_that_ends_gives_up_a_restore(pair: tuple[Machine, Machine], folder: Path) -> None:
    """It would be given the container as soon as it has the files."""
    _, b = pair
    order = RestoreVolume(volume=JOURNAL, placement=2, snapshot="0" * 64, size=SIZE)
    async with keeping(folder, b):
        b.fetch_content = stuck = StuckFetch()
        async with asyncio.timeout(60), b.managed():
            await b.manager.handle(order)
            await stuck.began.wait()
            b.quit.set()
        await b.manager.handle(order)
    assert b.of(VolumeRestored) == []
