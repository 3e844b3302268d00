"""How a stand-by learns that no master leads: at once by its watch, and nevertheless if that is silent."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from itertools import count

import pytest
from support.engine import until
from support.etcd import Cluster
from support.go_between import GoBetween

from rce_master.follower import StateFollower
from rce_master.leadership import LeaseSettings
from rce_master.leadership.keeper import LeadershipKeeper
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.layout import Keys, prepare
from rce_master.store.etcd.wire import Put

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

PATIENT = LeaseSettings(ttl=60.0)
LOOKS_AT_MOST = 4
"""Reads of the leadership by a stand-by in :data:`WATCHED_S`; without a watch it would be twelve."""
WATCHED_S = 3.0

_prefixes = (f"/engine{number}" for number in count())


class Rarely(LeaseSettings):
    """Times of a stand-by that relies on its watch alone."""

    @property
    def watched_poll(self) -> float:
        return 3600.0


class Pipe(GoBetween):
    """Passes connections on to a member; counts reads, and can hold back what the member says.

    Attributes:
        reads: Requests to read that were passed on.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        super().__init__((host, int(port)))
        self.reads = 0
        self._held: frozenset[bytes] = frozenset()

    def hold(self, *paths: bytes) -> None:
        """Hold back answers on connections whose newest request is for one of these paths."""
        self._held = frozenset(paths)

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = b""

        async def to_member() -> None:
            nonlocal request
            while piece := await reader.read(65536):
                if piece.startswith(b"POST "):
                    request = piece.split(b" ", 2)[1]
                    self.reads += request == b"/v3/kv/range"
                to.write(piece)
                await to.drain()
            raise ConnectionResetError

        async def from_member() -> None:
            while piece := await there.read(65536):
                if request in self._held:
                    await asyncio.Event().wait()
                writer.write(piece)
                await writer.drain()
            raise ConnectionResetError

        async with self.to_server() as (there, to), asyncio.TaskGroup() as group:
            group.create_task(to_member())
            group.create_task(from_member())


@contextlib.asynccontextmanager
async def standing_by(
    client: EtcdClient, prefix: str, settings: LeaseSettings
) -> AsyncIterator[tuple[LeadershipKeeper, StateFollower, asyncio.Task[object]]]:
    """Run a stand-by; give it once it watches and knows the leader, with what waits for the lead."""
    follower = StateFollower(client, prefix, None, asyncio.get_running_loop().time)
    keeper = LeadershipKeeper(client, prefix, "two", settings)
    keeper.on_save, keeper.is_watched = follower.saw, lambda: follower.is_watching
    follower.on_leadership = keeper.wake
    following = asyncio.create_task(follower.run())
    waiting: asyncio.Task[object] = asyncio.create_task(keeper.acquire())
    try:
        await until(lambda: follower.is_watching and keeper.leader, what="the stand-by watches")
        yield keeper, follower, waiting
    finally:
        for task in (waiting, following):
            task.cancel()
        await asyncio.gather(waiting, following, return_exceptions=True)
        if keeper.lease:
            await keeper.step_down()


async def led(client: EtcdClient) -> tuple[str, LeadershipKeeper]:
    """Begin an engine; return its prefix and its leader."""
    prefix = next(_prefixes)
    await prepare(client, prefix)
    leader = LeadershipKeeper(client, prefix, "one", PATIENT)
    await leader.acquire()
    return prefix, leader


async def test_the_watch_tells_of_the_end_of_the_lead(client: EtcdClient) -> None:
    prefix, leader = await led(client)
    async with standing_by(client, prefix, Rarely(ttl=60.0)) as (keeper, _, waiting):
        await leader.step_down()
        await asyncio.wait_for(waiting, 30.0)
        assert keeper.core.term == 2


async def test_a_new_leader_and_a_drain_are_known_by_the_watch(client: EtcdClient) -> None:
    prefix, leader = await led(client)
    async with standing_by(client, prefix, Rarely(ttl=60.0, drained_wait=3600.0)) as (keeper, _, waiting):
        await client.transact([], [Put(Keys(prefix).drained + "two", b"{}")])
        await until(lambda: keeper.is_drained, what="the stand-by knows that it is drained")
        await leader.step_down()
        third = LeadershipKeeper(client, prefix, "three", PATIENT)
        await third.acquire()
        await until(lambda: keeper.leader and keeper.leader.name == "three", what="it knows the new leader")
        assert not waiting.done()
        await third.step_down()


async def test_a_watching_stand_by_asks_rarely(client: EtcdClient, etcd: Cluster) -> None:
    prefix, leader = await led(client)
    pipe = Pipe(etcd.endpoints[0])
    async with (
        pipe.running(),
        EtcdClient([pipe.endpoint], attempt=20.0) as through,
        standing_by(through, prefix, PATIENT),
    ):
        before = pipe.reads
        await asyncio.sleep(WATCHED_S)
        assert pipe.reads - before <= LOOKS_AT_MOST
    await leader.step_down()


@pytest.mark.parametrize("held", [("/v3/watch",), ("/v3/watch", "/v3/kv/range", "/v3/kv/txn")])
async def test_a_silent_watch_is_not_relied_on(
    client: EtcdClient, etcd: Cluster, held: tuple[str, ...]
) -> None:
    """Its events were lost, or its member says nothing at all any more; no connection is closed."""
    prefix, leader = await led(client)
    pipe = Pipe(etcd.endpoints[0])
    async with (
        pipe.running(),
        EtcdClient([pipe.endpoint, etcd.endpoints[0]], attempt=2.0) as through,
        standing_by(through, prefix, PATIENT) as (keeper, _, waiting),
    ):
        pipe.hold(*(path.encode() for path in held))
        await leader.step_down()
        await asyncio.wait_for(waiting, 60.0)
        assert keeper.core.term == 2


async def test_a_watch_follows_the_member_that_answers(client: EtcdClient, etcd: Cluster) -> None:
    prefix, leader = await led(client)
    pipe = Pipe(etcd.endpoints[0])
    async with (
        pipe.running(),
        EtcdClient([pipe.endpoint, etcd.endpoints[0]], attempt=2.0) as through,
        standing_by(through, prefix, PATIENT) as (_, follower, waiting),
    ):
        pipe.hold(b"/v3/watch", b"/v3/kv/range")
        await until(lambda: not follower.is_watching, what="the watch is not trusted")
        await until(lambda: follower.is_watching, what="the other member is watched")
        assert follower.loads == 1
        await leader.step_down()
        await asyncio.wait_for(waiting, 60.0)
