"""Volumes go from one machine to another over a real master's port, and are saved while they are in use."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from pathlib import Path

import pytest
from support.containers import Machine, until
from support.control_ends import SECRET
from support.kept_snapshots import (
    BOX,
    IMAGES,
    JOURNAL,
    StuckUploader,
    files,
    keeping,
    put,
    restore,
    save,
)
from websockets.asyncio.server import ServerConnection, serve

from rce.control.messages import CONTROL_VERSION, SNAPSHOTS, SaveVolume, VolumeLimit, VolumeSaved, Welcome
from rce.control.snapshots import decode_manifest
from rce.control_channel.connections import OpenConnections
from rce.control_channel.dialing import Dialer
from rce.control_channel.uploads import Uploader
from rce.masters import Masters
from rce.model import MEGABYTE
from rce_container.volumes.store import VolumeStore


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
