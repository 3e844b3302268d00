"""The packages of a machine: fetched once, verified, kept within a limit, whole or not there at all."""

from __future__ import annotations

import asyncio
import errno
import os
import threading
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

import pytest
from support.user_packages import pack, sign, write_package

from rce.aio.backoff import Backoff
from rce.control.exceptions import ContentError
from rce.control.model import PackageSpec
from rce.control_channel.contents import Piece
from rce.packages import unpacking
from rce.packages.limits import ArchiveLimits
from rce.packages.unpacking import unpack
from rce_container.files import remove
from rce_container.packages import disk, shelf
from rce_container.packages.cache import PackageCache
from rce_container.packages.disk import replicate
from rce_container.packages.exceptions import FetchError, NoSpaceError, VerificationError
from rce_container.packages.shelf import Shelf
from rce_container.packages.supply import Library, Supply


class Depot:
    """A master's contents."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.contents: dict[str, bytes] = {}
        self.asked: list[tuple[str, int]] = []
        self.gate = asyncio.Event()
        self.gate.set()

    def make(self, name: str, version: str = "1.0", size: int = 10) -> PackageSpec:
        archive = pack(write_package(self.folder / version, name, run=os.urandom(size).hex()))
        spec = sign(archive, name, version)
        self.contents[spec.sha256] = archive
        return spec

    async def fetch(self, sha256: str, offset: int) -> Piece:
        self.asked.append((sha256, offset))
        await self.gate.wait()
        if sha256 not in self.contents:
            raise ContentError("the master is away")
        found = self.contents[sha256]
        return Piece(found[offset : offset + 100], len(found))


@pytest.fixture
def depot(tmp_path: Path) -> Depot:
    return Depot(tmp_path / "source")


def opened(depot: Depot, folder: Path, space: int = 1 << 20) -> PackageCache:
    made = PackageCache(folder, depot.fetch, space=space)
    made.open()
    return made


def kept(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if len(path.name) == 64}


async def test_many_who_ask_at_once_cause_one_fetch(depot: Depot, tmp_path: Path) -> None:
    cache = opened(depot, tmp_path / "cache")
    nav = depot.make("nav")
    paths = await asyncio.gather(*(cache.ensure("user", nav) for _ in range(10)))
    assert len(set(paths)) == 1
    assert (paths[0] / "nav" / "run.py").is_file()
    assert [offset for _, offset in depot.asked].count(0) == 1
    assert not list((tmp_path / "cache" / "incoming").iterdir())
    again = opened(depot, tmp_path / "cache")
    depot.contents.clear()
    assert await again.ensure("user", nav) == paths[0]


async def test_one_who_gives_up_does_not_spoil_it_for_the_others(depot: Depot, tmp_path: Path) -> None:
    cache = opened(depot, tmp_path / "cache")
    nav = depot.make("nav")
    depot.gate.clear()
    first = asyncio.create_task(cache.ensure("user", nav))
    second = asyncio.create_task(cache.ensure("user", nav))
    while not depot.asked:
        await asyncio.sleep(0)
    first.cancel()
    await asyncio.wait([first])
    depot.gate.set()
    assert (await second).is_dir()
    assert not list((tmp_path / "cache" / "incoming").iterdir())


async def test_what_nobody_holds_goes_when_room_is_needed(depot: Depot, tmp_path: Path) -> None:
    cache = opened(depot, tmp_path / "cache", space=9000)
    one, two, three, four = (depot.make(f"p{number}", size=2000) for number in range(4))
    cache.hold("box", {one.sha256})
    for spec in (one, two, three):
        await cache.ensure("user", spec)
    assert kept(tmp_path / "cache") == {one.sha256, three.sha256}
    await cache.ensure("user", one)
    cache.hold("box", set())
    await cache.ensure("user", four)
    assert kept(tmp_path / "cache") == {one.sha256, four.sha256}


async def test_packages_that_arrive_together_make_room(depot: Depot, tmp_path: Path) -> None:
    """Packages that arrive at the same time in a full cache are all provided."""
    old = [depot.make(f"old{number}", size=2000) for number in range(4)]
    new = [depot.make(f"new{number}", size=2000) for number in range(4)]
    cache = opened(depot, tmp_path / "cache")
    for spec in old:
        await cache.ensure("user", spec)
    cache = opened(depot, tmp_path / "cache", space=1)
    cache.hold("box", {spec.sha256 for spec in new})
    users = [cache.ensure("user", spec) for spec in new]
    assert all(path.is_dir() for path in await asyncio.gather(*users))
    assert kept(tmp_path / "cache") == {spec.sha256 for spec in new}


async def test_a_fault_delays_a_package(
    depot: Depot, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A fault of the program is logged and told once, and the package is tried again."""
    faults = [KeyError("a fault"), KeyError("a fault")]

    async def fetch(sha256: str, offset: int) -> Piece:
        if faults:
            raise faults.pop()
        return await depot.fetch(sha256, offset)

    cache = PackageCache(tmp_path / "cache", fetch, space=1 << 20)
    library = Library(cache=cache, retry=Backoff(first=0.01, longest=0.01))
    library.open()
    nav = depot.make("nav")
    (tmp_path / "box").mkdir()
    box = Shelf(tmp_path / "box", link=True)
    told: list[str] = []
    arrived = asyncio.Event()
    supply = Supply("box", "user", library, box, tell=told.append, on_arrival=arrived.set)
    supply.want([nav])
    await asyncio.wait_for(arrived.wait(), 30)
    await supply.close()
    assert box.has(nav.sha256)
    assert len(told) == 1
    assert told[0].startswith("package nav 1.0 is not there yet: a fault on the container's machine")
    assert [record.exc_info is not None for record in caplog.records] == [True]


async def test_what_is_not_what_was_signed_is_refused(depot: Depot, tmp_path: Path) -> None:
    cache = opened(depot, tmp_path / "cache")
    nav = depot.make("nav")
    with pytest.raises(VerificationError, match="does not fit the key"):
        await cache.ensure("eve", nav)
    assert depot.asked == []
    other = depot.make("other")
    depot.contents[nav.sha256] = depot.contents[other.sha256]
    with pytest.raises(VerificationError, match="not what was signed"):
        await cache.ensure("user", nav)
    wrong = sign(depot.contents[other.sha256], "nav", "1.0")
    with pytest.raises(VerificationError, match="holds the package 'other'"):
        await cache.ensure("user", wrong)
    garbage = sign(b"garbage", "nav", "1.0")
    depot.contents[garbage.sha256] = b"garbage"
    with pytest.raises(VerificationError, match="cannot be unpacked"):
        await cache.ensure("user", garbage)
    small = PackageCache(tmp_path / "cache", depot.fetch, space=1, limits=ArchiveLimits(archive=50))
    with pytest.raises(VerificationError, match="more than 50 bytes"):
        await small.ensure("user", other)
    del depot.contents[nav.sha256]
    with pytest.raises(FetchError, match="the master is away"):
        await cache.ensure("user", nav)
    assert kept(tmp_path / "cache") == set()
    assert not list((tmp_path / "cache" / "incoming").iterdir())


async def test_a_full_disk_is_told_and_leaves_nothing(
    depot: Depot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = opened(depot, tmp_path / "cache")
    nav = depot.make("nav")

    def full(file: BinaryIO, into: Path, limits: ArchiveLimits) -> None:
        unpack(file, into, limits)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(unpacking, "unpack", full)
    with pytest.raises(NoSpaceError, match="disk of the container's machine is full"):
        await cache.ensure("user", nav)
    assert not list((tmp_path / "cache" / "incoming").iterdir())
    monkeypatch.undo()
    assert (await cache.ensure("user", nav)).is_dir()


async def test_a_machine_that_was_started_anew_fetches_anew(
    depot: Depot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nav = depot.make("nav")
    await opened(depot, tmp_path / "cache").ensure("user", nav)
    (tmp_path / "cache" / "incoming" / "half").mkdir()
    opened(depot, tmp_path / "cache")
    assert kept(tmp_path / "cache") == {nav.sha256}
    assert not (tmp_path / "cache" / "incoming").exists()
    (tmp_path / "boot").write_text("another one\n")
    monkeypatch.setattr(disk, "BOOT_ID", tmp_path / "boot")
    opened(depot, tmp_path / "cache")
    assert kept(tmp_path / "cache") == set()


def test_a_tree_is_linked_or_copied(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "sub").mkdir(parents=True)
    (source / "sub" / "file").write_text("x")
    (source / "sub" / "file").chmod(0o444)
    (source / "link").symlink_to("sub/file")
    replicate(source, tmp_path / "linked", link=True)
    replicate(source, tmp_path / "copied", link=False)
    number = (source / "sub" / "file").stat().st_ino
    assert (tmp_path / "linked" / "sub" / "file").stat().st_ino == number
    assert (tmp_path / "copied" / "sub" / "file").stat().st_ino != number
    assert str((tmp_path / "copied" / "link").readlink()) == "sub/file"


def test_a_shelf_keeps_the_newest_of_what_nobody_names(tmp_path: Path) -> None:
    tree = tmp_path / "tree" / "nav"
    tree.mkdir(parents=True)
    folder = tmp_path / "box" / "bundles"
    folder.mkdir(parents=True)
    made = Shelf(folder, link=True)
    for number in range(shelf.KEPT + 3):
        made.place(str(number), tree.parent, None)
        os.utime(folder / str(number), (number, number))
    made.tidy({"0"})
    assert {path.name for path in folder.iterdir()} == {"0", *(str(n) for n in range(3, shelf.KEPT + 3))}


def test_a_package_is_off_the_shelf_before_its_removal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that starts meanwhile would find a part of it."""
    (tmp_path / "tree").mkdir()
    folder = tmp_path / "box" / "bundles"
    folder.mkdir(parents=True)
    made = Shelf(folder, link=True)
    for number in range(shelf.KEPT + 1):
        made.place(str(number), tmp_path / "tree", None)
        os.utime(folder / str(number), (number, number))
    is_there: list[bool] = []

    def look(path: Path) -> None:
        is_there.append(made.has("0"))
        remove(path)

    for module in (disk, shelf):
        monkeypatch.setattr(module, "remove", look, raising=False)
    made.tidy(())
    assert is_there == [False]
    assert list((tmp_path / "box" / "bundles.new").iterdir()) == []


async def test_a_package_wanted_again_during_tidying_stays(
    depot: Depot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, go_on, tidy = threading.Event(), threading.Event(), Shelf.tidy

    def tidy_when_told(shelf: Shelf, wanted: Collection[str]) -> None:
        began.set()
        go_on.wait(60)
        tidy(shelf, wanted)

    cache = opened(depot, tmp_path / "cache")
    old, new = depot.make("nav", "1.0"), depot.make("nav", "1.1")
    (tmp_path / "box").mkdir()
    box = Shelf(tmp_path / "box", link=True)
    box.place(old.sha256, await cache.ensure("user", old), None)
    os.utime(tmp_path / "box" / old.sha256, (0, 0))
    for number in range(shelf.KEPT):  # so that the old one is too many
        (tmp_path / "box" / str(number)).mkdir()
    monkeypatch.setattr(Shelf, "tidy", tidy_when_told)
    arrived = asyncio.Event()
    supply = Supply("box", "user", Library(cache=cache), box, tell=lambda _: None, on_arrival=arrived.set)
    supply.want([new])
    await asyncio.to_thread(began.wait, 60)
    supply.want([old])
    for _ in range(10):
        await asyncio.sleep(0)  # it would be found on the shelf
    go_on.set()
    await asyncio.wait_for(arrived.wait(), 60)
    await supply.close()
    assert box.has(old.sha256)


def test_a_container_that_is_gone_gets_nothing(tmp_path: Path) -> None:
    (tmp_path / "tree").mkdir()
    with pytest.raises(FileNotFoundError):
        Shelf(tmp_path / "gone" / "bundles", link=True).place("0", tmp_path / "tree", None)
    assert not (tmp_path / "gone").exists()
