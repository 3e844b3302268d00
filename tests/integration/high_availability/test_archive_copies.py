"""The leading master compares its contents with those of a stand-by that listens."""

from __future__ import annotations

import asyncio
import hashlib
from collections import Counter
from collections.abc import AsyncIterator, Collection, Iterable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import cast

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from aiohttp.typedefs import Handler
from support.engine import until
from support.ports import free_port

from rce.aio.tasks import TaskScope, cancel_and_wait
from rce.config import Secret
from rce.control.snapshots import FileEntry, Manifest
from rce_master.exceptions import StoreError
from rce_master.http.archives import ArchiveRoutes
from rce_master.http.leader_check import LeaderCheck
from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings
from rce_master.leadership.registry import MasterRegistry
from rce_master.leadership.request_key import RequestKey
from rce_master.leadership.standby_client import StandbyClient
from rce_master.packages.contents import ARCHIVES_PATH, ContentStore
from rce_master.packages.copies import ArchiveCopies, Forget
from rce_master.packages.transfer import ArchiveClient
from rce_master.snapshots.service import SnapshotService
from rce_master.state.changes import make_row
from rce_master.state.tables import Tables
from rce_master.state.volume_records import UserVolume
from rce_master.state_service import StateService
from rce_master.store import MemoryStore
from rce_master.store.etcd.layout import OtherMaster

MANY = 20_000
KEY = RequestKey(Secret("the secret of the masters"))


def hashes(count: int, what: str = "needed") -> list[str]:
    return [hashlib.sha256(f"{what} {number}".encode()).hexdigest() for number in range(count)]


def fill(folder: Path, names: Iterable[str]) -> None:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()


class Known:
    """A registry.

    Attributes:
        masters: The other masters.
    """

    def __init__(self, url: str) -> None:
        self.masters = [OtherMaster("other", url)]

    async def others(self) -> list[OtherMaster]:
        return self.masters


class Counted:
    """Needed contents, and how often they were asked for."""

    def __init__(self, needed: Iterable[str]) -> None:
        self.needed = set(needed)
        self.complete = True
        self.calls: Counter[str] = Counter()

    async def look(self) -> None:
        self.calls["look"] += 1

    def hashes(self) -> set[str]:
        self.calls["hashes"] += 1
        return set(self.needed)

    def is_needed(self, sha256: str) -> bool:
        self.calls["is_needed"] += 1
        return sha256 in self.needed

    def is_complete(self) -> bool:
        return self.complete


class Gate:
    """Holds back what a stand-by is asked for, as if it hung.

    Attributes:
        method: Of the requests that are held back; empty: none are.
        held: How many were held back so far.
    """

    def __init__(self) -> None:
        self.method = ""
        self.held = 0
        self._opened = asyncio.Event()

    def open(self) -> None:
        self.method = ""
        self._opened.set()

    @web.middleware
    async def wait(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.method == self.method:
            self.held += 1
            await self._opened.wait()
        return await handler(request)


class Pair:
    """A leading master's copies, and the folder of a stand-by."""

    def __init__(self, copies: ArchiveCopies, registry: Known, own: Path, others: Path, gate: Gate) -> None:
        self.copies = copies
        self.registry = registry
        self.own = own
        self.others = others
        self.gate = gate

    @asynccontextmanager
    async def comparing(self, needed: Counted, forget: Forget | None = None) -> AsyncIterator[None]:
        running = asyncio.create_task(self.copies.run(needed, forget))
        try:
            yield
        finally:
            await cancel_and_wait(running)


@pytest.fixture
async def pair(tmp_path: Path) -> AsyncIterator[Pair]:
    own, others = tmp_path / "own", tmp_path / "others"
    gate = Gate()
    app = web.Application(middlewares=[gate.wait])
    ArchiveRoutes(ContentStore(others), LeaderCheck(KEY, lambda: 1), ARCHIVES_PATH).add_to(app)
    core = LeadershipCore(LeaseSettings())
    core.granted(0.0, 3.0)
    core.elected(1, 0.0)
    async with TestServer(app) as server, aiohttp.ClientSession() as session:
        registry = Known(str(server.make_url("/")))
        client = StandbyClient(session, KEY, Fence(core, lambda: 0.0, "leader"))
        copies = ArchiveCopies(
            ContentStore(own), cast("MasterRegistry", registry), ArchiveClient(client, ARCHIVES_PATH)
        )
        yield Pair(copies, registry, own, others, gate)
        gate.open()


async def test_many_held_contents_are_listed_once(pair: Pair) -> None:
    """The work of a comparison grows with the number of contents, not with its square."""
    needed, unneeded = hashes(MANY), hashes(3, "unneeded")
    fill(pair.own, needed)
    fill(pair.others, [*needed, *unneeded])
    counted = Counted(needed)
    async with pair.comparing(counted):
        await until(lambda: not any((pair.others / name).exists() for name in unneeded))
    assert counted.calls["hashes"] <= 4, "at most two comparisons, of two lists each"
    assert counted.calls["is_needed"] <= 2 * len(unneeded)
    assert len(list(pair.others.iterdir())) == MANY


async def test_contents_that_are_sent_are_not_removed(pair: Pair) -> None:
    pushed, unneeded = hashes(50, "pushed"), hashes(1, "unneeded")
    fill(pair.own, pushed)
    fill(pair.others, [*pushed, *unneeded])
    async with pair.comparing(Counted(())):
        async with pair.copies.spread(*pushed):
            await until(lambda: not (pair.others / unneeded[0]).exists())
            assert len(list(pair.others.iterdir())) == len(pushed)
        # A second push of the same contents is counted for itself.
        async with pair.copies.spread(*pushed[:2]), pair.copies.spread(*pushed[:1]):
            await until(lambda: not (pair.others / pushed[2]).exists())
            assert (pair.others / pushed[0]).exists()


async def test_a_silent_standby_does_not_delay_other_pushes(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a push of the same content waits for the end of a removal, and then sends it again."""
    monkeypatch.setattr("rce_master.packages.transfer.REMOVAL_S", 3600.0)
    (pushed,), (removed,) = write(pair.own, b"pushed"), write(pair.others, b"removed")
    write(pair.own, b"removed")
    pair.gate.method = "DELETE"

    async def push(content: str) -> bool:
        async with pair.copies.spread(content):
            return (pair.others / content).exists()

    async with pair.comparing(Counted(())):
        await until(lambda: pair.gate.held)
        async with asyncio.timeout(60):
            assert await push(pushed), "while the removal of the other one is not answered"
        pushing_again = asyncio.create_task(push(removed))
        await push(pushed)
        assert not pushing_again.done()
        pair.gate.open()
        assert await pushing_again


async def test_a_master_that_is_alone_warns_of_one_copy(pair: Pair, caplog: pytest.LogCaptureFixture) -> None:
    """More than half of one master is that one; the operator is told once, and each owner is."""
    pushed = hashes(2, "pushed")
    fill(pair.own, pushed)
    fill(pair.others, pushed)
    known = pair.registry.masters
    warning = "packages are on one machine only, because no other master is known"
    for masters, warned, logged in (([], True, 1), ([], True, 1), (known, False, 1), ([], True, 2)):
        pair.registry.masters = masters
        async with pair.copies.spread(*pushed) as told:
            assert (warning in told) == warned
            assert caplog.text.count(warning) == logged


async def test_contents_stay_while_it_is_unknown_what_is_needed(pair: Pair) -> None:
    unneeded = hashes(2, "unneeded")
    fill(pair.others, unneeded)
    counted = Counted(())
    counted.complete = False
    async with pair.comparing(counted):
        await until(lambda: counted.calls["look"] >= 2)  # each comparison looks twice
        pair.copies.look()
        await until(lambda: counted.calls["look"] >= 3)  # the first one has ended
        assert len(list(pair.others.iterdir())) == len(unneeded)
        counted.complete = True
        pair.copies.look()
        await until(lambda: not list(pair.others.iterdir()))


async def test_own_folder_that_cannot_be_read_is_looked_at_again(
    pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    unneeded = hashes(1, "unneeded")
    fill(pair.others, unneeded)
    pair.own.touch()  # a file, which has no entries
    async with pair.comparing(Counted(())):
        await until(lambda: "packages are incomplete: [Errno 20]" in caplog.text)
        pair.own.unlink()
        pair.own.mkdir()
        pair.copies.look()
        await until(lambda: not (pair.others / unneeded[0]).exists())


def write(folder: Path, *contents: bytes) -> list[str]:
    """Write contents under their hashes, which are returned."""
    folder.mkdir(exist_ok=True)
    names = [hashlib.sha256(content).hexdigest() for content in contents]
    for name, content in zip(names, contents, strict=True):
        (folder / name).write_bytes(content)
    return names


async def test_contents_that_no_master_has_do_not_stop_the_others(
    pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    here, there = write(pair.own, b"a", b"b"), write(pair.others, b"c", b"d")
    unneeded = hashes(1, "unneeded")
    fill(pair.others, unneeded)
    async with pair.comparing(Counted([*here, *there, *hashes(20, "lost")])):
        await until(lambda: all((pair.own / name).exists() for name in there))
        await until(lambda: all((pair.others / name).exists() for name in here))
        await until(lambda: not (pair.others / unneeded[0]).exists())
    assert "packages are incomplete: 20 are missing, such as" in caplog.text


async def test_contents_are_lost_once_all_other_masters_tell_so(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair.own.mkdir()
    forgotten: list[set[str]] = []
    lost = hashes(2, "lost")
    counted = Counted(lost)

    async def forget(contents: Collection[str]) -> None:
        forgotten.append(set(contents))

    async def compare_once() -> None:
        looks = counted.calls["look"]
        pair.copies.look()
        await until(lambda: counted.calls["look"] >= looks + 4)  # a whole comparison has ended

    pair.registry.masters.append(OtherMaster("away", f"http://127.0.0.1:{free_port()}/"))
    async with pair.comparing(counted, forget):
        await compare_once()
        monkeypatch.setattr("rce_master.packages.copies.LOST_S", 0.0)
        await compare_once()
        assert not forgotten, "one master may have them"
        pair.registry.masters.pop()
        monkeypatch.setattr("rce_master.packages.copies.LOST_S", 900.0)
        await compare_once()
        assert not forgotten, "a master may not be known yet"
        monkeypatch.setattr("rce_master.packages.copies.LOST_S", 0.0)
        pair.copies.look()
        await until(lambda: forgotten)
    assert forgotten[0] == set(lost)


async def test_volumes_forget_snapshots_that_no_master_has(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rce_master.packages.copies.LOST_S", 0.0)
    tables = Tables()
    missing_piece = hashes(1, "piece")[0]
    file = FileEntry(path=b"f", mode=0o644, modified_ns=0, size=1, pieces=(bytes.fromhex(missing_piece),))
    (partial,) = write(pair.others, Manifest(entries=(file,)).encode())
    (whole,) = write(pair.others, Manifest(entries=()).encode())
    snapshots = {"lost": hashes(1)[0], "partial": partial, "whole": whole}
    volumes = [UserVolume(user="anna", name=name, size=1, snapshot=of) for name, of in snapshots.items()]
    for volume in volumes:
        tables.volumes.assign(volume.id, volume)
    store = MemoryStore()
    await store.save([make_row(tables.volumes, volume.id) for volume in volumes], await store.begin_term())
    state_service = await StateService.open(store)
    service = SnapshotService(state_service, ContentStore(pair.own), copies=pair.copies)
    pair.own.mkdir()

    def left() -> list[str]:
        return [one.name for one in state_service.tables.volumes if one.snapshot]

    async with TaskScope() as tasks:
        tasks.spawn(state_service.run(), name="state")
        tasks.spawn(service.run(), name="snapshots")
        await until(lambda: left() == ["whole"])
        await until((pair.own / whole).exists)


@asynccontextmanager
async def silent_master(pair: Pair) -> AsyncIterator[list[str]]:
    """Let the masters begin with one that hung within its answers; yield what was fetched from it."""
    asked: list[str] = []
    ended = asyncio.Event()

    async def answer(request: web.Request) -> web.StreamResponse:
        reply = web.StreamResponse()
        reply.content_length = 1000
        if request.path != ARCHIVES_PATH:
            asked.append(request.path)
            await reply.prepare(request)
            await reply.write(b"the first bytes")
        await ended.wait()
        return reply

    app = web.Application()
    app.router.add_get(ARCHIVES_PATH, answer)
    app.router.add_get(ARCHIVES_PATH + "/{sha256}", answer)
    async with TestServer(app) as server:
        pair.registry.masters.insert(0, OtherMaster("silent", str(server.make_url("/"))))
        yield asked
        ended.set()


async def test_missing_contents_are_fetched_where_they_are_listed(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rce_master.packages.copies.HELD_S", 1.0)
    pair.own.mkdir()
    there = write(pair.others, *(b"%d" % number for number in range(100)))
    async with silent_master(pair) as asked, pair.comparing(Counted(there)):
        await until(lambda: all((pair.own / name).exists() for name in there))
    assert not asked


async def test_master_that_goes_silent_within_a_content_is_left(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked last for the next ones."""
    monkeypatch.setattr("rce_master.packages.transfer.SILENCE_S", 2.0)
    pair.own.mkdir()
    there = write(pair.others, *(b"%d" % number for number in range(100)))
    async with silent_master(pair) as asked, asyncio.timeout(60):
        for name in there:
            while not (pair.own / name).exists():
                with suppress(OSError):  # it is being fetched yet
                    await pair.copies.obtain(name)
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("size", "why"), [(64 << 20, "it took nothing of the file for 1 s"), (1, "no answer in time")]
)
async def test_send_ends_when_a_master_takes_nothing(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, size: int, why: str
) -> None:
    """The limit for the whole archive, of more than a minute here, is that of a slow network."""
    monkeypatch.setattr("rce_master.packages.transfer.STALL_S", 1.0)
    monkeypatch.setattr("rce_master.packages.transfer.ANSWER_S", 1.0)
    pair.own.mkdir()
    (large,) = hashes(1, "large")
    with (pair.own / large).open("wb") as file:
        file.truncate(size)
    pair.gate.method = "PUT"
    async with asyncio.timeout(40):
        with pytest.raises(StoreError, match=f"other: {why}"):
            async with pair.copies.spread(large):
                pass
