"""Orders to save and restore volumes over a real master's port: repeated, refused, and given up."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import threading
from pathlib import Path

import pytest
from support.containers import Machine, until
from support.kept_snapshots import (
    BOX,
    IMAGES,
    JOURNAL,
    SIZE,
    StuckUploader,
    files,
    keeping,
    put,
    restore,
    save,
)

from rce.control.messages import (
    RemoveVolume,
    RestoreVolume,
    SaveVolume,
    VolumeLimit,
    VolumeRemoved,
    VolumeRestored,
    VolumeSaved,
)
from rce.control.snapshots import digest
from rce.control_channel.contents import Piece
from rce.model import MEGABYTE
from rce_container.volumes import snapshots, tree
from rce_container.volumes.places import VolumePlaces


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
