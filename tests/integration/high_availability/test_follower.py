"""A stand-by's copy of the state, on a real etcd: what it has at a takeover is what etcd has."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from itertools import count

import pytest
from support.engine import until
from support.etcd import Cluster
from support.go_between import GoBetween

from rce.control.messages import CONTROL_VERSION, Hello, MachineInfo, TaskSetKind
from rce.model import Resources
from rce.model.specs import InterfaceSpec
from rce_master.follower import StateFollower
from rce_master.state import commands
from rce_master.state.core import State
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import User, UserRole
from rce_master.state_service import StateService
from rce_master.store import Row
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.layout import Keys, prepare
from rce_master.store.etcd.wire import Delete, as_it_is

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

_prefixes = (f"/engine{number}" for number in count())


class Leader:
    """Writes a state to etcd."""

    def __init__(self, client: EtcdClient, prefix: str, settings: StateSettings | None = None) -> None:
        self.client = client
        self.prefix = prefix
        self.settings = settings

    @contextlib.asynccontextmanager
    async def leading(self) -> AsyncIterator[None]:
        await prepare(self.client, self.prefix)
        self.service = await StateService.open(EtcdStore(self.client, self.prefix), self.settings)
        running = asyncio.create_task(self.service.run())
        try:
            yield
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    async def add(self, name: str, containers: int = 2) -> None:
        user = User(name=name, role=UserRole.ADMIN, password="x", created=0.0)
        await self.service.submit(commands.AddUser(user=user))
        for number in range(containers):
            tag = f"c{number}"
            await self.service.submit(
                commands.CreateContainer(user=name, tag=tag, resources=Resources(), wait=True)
            )
            if number % 2:
                await self.service.submit(commands.DestroyContainer(user=name, tag=tag))

    async def add_robot(self, user: str, interfaces: int) -> None:
        """Add a user with a robot, which leaves again."""
        await self.add(user, 0)
        robots = Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.ROBOT,
            process="r1",
            machine=MachineInfo(name="m"),
            url="ws://r1/",
        )
        await self.service.submit(commands.TaskSetArrived(hello=robots))
        await self.service.submit(commands.RobotLogin(process="r1", id=f"{user}/rob"))
        specs = [
            InterfaceSpec(tag=f"in{number}", type="PublisherConverter", message_type="std_msgs/String")
            for number in range(interfaces)
        ]
        adding = [commands.AddInterface(user=user, endpoint="rob", interface=spec) for spec in specs]
        for begin in range(0, interfaces, 500):
            outcomes = await self.service.submit_all(adding[begin : begin + 500])
            assert set(outcomes) == {None}
        await self.service.submit(commands.RobotLeft(process="r1", id=f"{user}/rob"))

    async def remove(self, name: str) -> None:
        await self.service.submit(commands.RemoveUser(name=name))


@contextlib.asynccontextmanager
async def following(client: EtcdClient, prefix: str) -> AsyncIterator[StateFollower]:
    follower = StateFollower(client, prefix, None, asyncio.get_running_loop().time)
    running = asyncio.create_task(follower.run())
    try:
        await until(lambda: follower.loads, what="the copy is loaded")
        yield follower
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


def image(state: State) -> dict[str, dict[str, bytes]]:
    tables = [table for table in state.tables.all if table.persistent]
    return {table.name: {table.key(one): table.encode(one) for one in table} for table in tables}


async def take(client: EtcdClient, prefix: str, follower: StateFollower) -> dict[str, dict[str, bytes]]:
    """Take over; return the copy, and check that it is what a new load gives."""
    store = EtcdStore(client, prefix)
    await store.begin_term()
    state = await follower.take(store.begun)
    assert state is not None
    loaded = State()
    for _ in loaded.reading(await store.load()):
        pass
    found = image(state)
    assert found == image(loaded)
    for _ in state.beginning(0.0, 0):
        pass
    state.validate()
    return found


async def test_the_copy_is_what_etcd_has(client: EtcdClient) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    async with leader.leading():
        await leader.add("before")
        async with following(client, prefix) as follower:
            await leader.add("anna")
            await leader.add("bert")
            await leader.remove("anna")
            copy = await take(client, prefix, follower)
            assert follower.loads == 1
    assert set(copy["users"]) == {"before", "bert"}


async def test_a_robot_with_many_interfaces_does_not_stop_the_tick(client: EtcdClient) -> None:
    """It has more rows than etcd allows in one level of a transaction."""
    prefix = next(_prefixes)
    leader = Leader(client, prefix, StateSettings(robot_grace=0.0))
    async with leader.leading():
        await leader.add_robot("anna", 5000)
        async with following(client, prefix) as follower:
            await leader.service.submit(commands.Tick())
            copy = await take(client, prefix, follower)
            assert follower.loads == 1
    assert not copy["endpoints"]
    assert not copy["interfaces"]


async def test_what_the_watch_missed_is_read_at_the_takeover(client: EtcdClient) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    async with leader.leading():
        for name in ("anna", "bert", "carl"):
            await leader.add(name)
        async with following(client, prefix) as follower:
            pass  # from here on it hears nothing
        await leader.remove("anna")
        await leader.add("dora")
        await leader.remove("bert")
        await leader.add("bert", 4)
        copy = await take(client, prefix, follower)
    assert set(copy["users"]) == {"bert", "carl", "dora"}
    assert follower.loads == 1


async def test_rows_of_a_newer_release_stay(client: EtcdClient) -> None:
    """The copy counts them, though it has no table for them."""
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    async with leader.leading():
        await leader.add("anna")
        store = leader.service._store
        await store.save([Row("of_tomorrow", "a", b"1"), Row("of_tomorrow", "b", b"2")], leader.service._term)
        async with following(client, prefix) as follower:
            await store.save(
                [Row("of_tomorrow", "c", b"3"), Row("of_tomorrow", "a", None)], leader.service._term
            )
            await leader.add("bert")
            await take(client, prefix, follower)


async def test_a_copy_that_lacks_a_row_is_not_used(client: EtcdClient) -> None:
    """A row whose copy was lost, as by a fault of memory or of this program."""
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    async with leader.leading():
        await leader.add("anna")
        async with following(client, prefix) as follower:
            assert follower._state is not None
            follower._state.tables.users.assign("anna", None)
            store = EtcdStore(client, prefix)
            await store.begin_term()
            assert await follower.take(store.begun) is None


async def test_lag_is_told_and_ends(client: EtcdClient) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    watched = EtcdStore(client, prefix)
    async with leader.leading():
        await leader.add("anna")
        async with following(client, prefix) as follower:
            await leader.add("bert")
            follower.saw((await watched.leadership()).last)
            await until(lambda: follower.lag.revisions == 0, what="the copy has caught up")
            assert follower.seconds_behind == 0.0
        await leader.add("carl")
        follower.saw((await watched.leadership()).last)
        assert follower.lag.revisions > 0
        await until(lambda: follower.seconds_behind > 0, what="time passes")


async def test_after_a_compaction_the_copy_is_loaded_anew(client: EtcdClient, etcd: Cluster) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    gate = Gate(etcd.endpoints[0])
    async with (
        leader.leading(),
        gate.running(),
        EtcdClient([gate.endpoint], attempt=20.0) as through,
        following(through, prefix) as follower,
    ):
        await leader.add("anna")
        await gate.close()
        await leader.add("bert")
        await leader.remove("anna")
        revision = (await client.range(Keys(prefix).root, limit=1)).revision
        await client._call("v3/kv/compaction", {"revision": str(revision)}, as_it_is)
        await gate.open()
        await until(lambda: follower.loads == 2, what="the copy is loaded anew")
        await take(client, prefix, follower)


async def test_a_broken_watch_goes_on_where_it_broke(client: EtcdClient, etcd: Cluster) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    gate = Gate(etcd.endpoints[0])
    async with (
        leader.leading(),
        gate.running(),
        EtcdClient([gate.endpoint], attempt=20.0) as through,
        following(through, prefix) as follower,
    ):
        await gate.close()
        await leader.add("anna")
        await gate.open()
        last = (await EtcdStore(client, prefix).leadership()).last
        await until(lambda: follower.lag.applied >= last, what="the watch goes on")
        await take(client, prefix, follower)
        assert follower.loads == 1


async def test_a_damaged_row_is_told(client: EtcdClient, caplog: pytest.LogCaptureFixture) -> None:
    prefix = next(_prefixes)
    leader = Leader(client, prefix)
    async with leader.leading():
        await leader.add("anna")
        async with following(client, prefix) as follower:
            await leader.service._store.save([Row("users", "x", b"no record")], leader.service._term)
            await until(lambda: "cannot be read" in caplog.text, what="the log tells")
            await client.transact([], [Delete(Keys(prefix).row("users", "x"))])
            await until(lambda: follower.loads == 2, what="the copy is loaded anew")


class Gate(GoBetween):
    """Passes connections on to a server, or breaks and refuses them."""

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        super().__init__((host, int(port)))

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with self.to_server() as (there, to), asyncio.TaskGroup() as group:
            group.create_task(_pass(reader, to))
            group.create_task(_pass(there, writer))


async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while piece := await reader.read(65536):
        writer.write(piece)
        await writer.drain()
    raise ConnectionResetError
