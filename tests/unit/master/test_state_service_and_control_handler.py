"""The state service, the reconciler and the desk, with task sets that live in the test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import pytest
from argon2 import PasswordHasher

from rce.control.desired import DesiredState, Fit
from rce.control.exceptions import PeerTimeoutError
from rce.control.logs import LogQuery
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Drop,
    Fault,
    Gone,
    Hello,
    Left,
    LogChunk,
    Login,
    LoginReply,
    MachineInfo,
    Notify,
    PatchSpec,
    PatchStatus,
    Probe,
    Put,
    SpecWanted,
    Status,
    StatusWanted,
    Sync,
    TaskSetKind,
    ToTaskSet,
    Usage,
)
from rce.control.model import PATCHES, EndpointState, EndpointStatus, LinkAddress, StatusPatch
from rce_master.auth import Authenticator, client_digest
from rce_master.control_handler import ControlHandler
from rce_master.exceptions import MasterError, NotFoundError, StoreError, TaskSetAwayError
from rce_master.reconciler import Reconciler
from rce_master.state import commands
from rce_master.state.records import User, UserRole
from rce_master.state_service import StateService
from rce_master.store import MemoryStore, Row

M = TypeVar("M")
HASHER = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
PASSWORD = client_digest("secret")


class FragileStore(MemoryStore):
    """Breaks when told to, and notes how often it wrote."""

    def __init__(self) -> None:
        super().__init__()
        self.broken = False
        self.saves = 0
        self.free = asyncio.Event()
        self.free.set()

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        await self.free.wait()
        self.saves += 1
        if self.broken:
            raise StoreError("disk full")
        await super().save(rows, term)


class FakePeer:
    """A task set: what the master sends it lies in ``inbox``."""

    def __init__(self, cloud: Cloud, process: str, kind: TaskSetKind) -> None:
        self.cloud = cloud
        self.process = process
        self.kind = kind
        self.inbox: asyncio.Queue[ToTaskSet] = asyncio.Queue()
        self.log = LogChunk(request=0, offset=5, text="hello")
        self.requests = 0
        self.features: frozenset[str] = frozenset()

    def send(self, message: ToTaskSet) -> None:
        self.inbox.put_nowait(message)

    async def read_log(
        self,
        id: str,  # noqa: A002 - wire name
        node: str,
        offset: int = 0,
        limit: int = 65536,
        query: LogQuery = LogQuery(),  # noqa: B008 - it is frozen
    ) -> LogChunk:
        if self.log.text == "away":
            raise PeerTimeoutError(self.process, 1.0)
        return self.log

    async def get(self, kind: type[M]) -> M:
        """Take messages until one of a kind comes."""
        async with asyncio.timeout(5):
            while True:
                message = await self.inbox.get()
                if isinstance(message, kind):
                    return message

    async def hello(self, *endpoints: EndpointStatus) -> Sync:
        await self.cloud.control_handler.on_hello(
            self,
            Hello(
                version=CONTROL_VERSION,
                kind=self.kind,
                process=self.process,
                machine=MachineInfo(name="m"),
                url="ws://x/",
                endpoints=endpoints,
            ),
        )
        return await self.get(Sync)

    async def say(self, message: Any) -> None:
        await self.cloud.control_handler.on_message(self, message)

    async def login(self, robot: str = "rob", password: str = PASSWORD) -> LoginReply:
        self.requests += 1
        await self.say(Login(request=self.requests, user="anna", robot=robot, password=password))
        reply = await self.get(LoginReply)
        assert reply.request == self.requests
        return reply

    async def ask(self, kind: str, data: object, robot: str = "rob") -> tuple[str, ...]:
        self.requests += 1
        await self.say(ClientRequest(request=self.requests, id=f"anna/{robot}", type=kind, data=data))
        reply = await self.get(ClientReply)
        assert reply.request == self.requests
        return reply.errors


class Cloud:
    def __init__(self, state_service: StateService, store: FragileStore) -> None:
        self.state_service = state_service
        self.store = store
        self.reconciler = Reconciler(state_service)
        self.auth = Authenticator(state_service.tables, hasher=HASHER)
        self.control_handler = ControlHandler(state_service, self.reconciler, self.auth)

    def robots(self, process: str = "r1") -> FakePeer:
        return FakePeer(self, process, TaskSetKind.ROBOT)

    def containers(self, process: str = "c1") -> FakePeer:
        return FakePeer(self, process, TaskSetKind.CONTAINER)

    async def flush(self) -> None:
        """Wait until all that was sent before is done."""
        await self.state_service.submit(commands.Tick())


@asynccontextmanager
async def running(store: FragileStore) -> AsyncIterator[Cloud]:
    cloud = Cloud(await StateService.open(store), store)
    async with asyncio.TaskGroup() as group:
        workers = [
            group.create_task(cloud.state_service.run()),
            group.create_task(cloud.control_handler.run()),
        ]
        await asyncio.sleep(0)
        if "anna" not in cloud.state_service.tables.users:
            user = User(name="anna", role=UserRole.USER, password=HASHER.hash(PASSWORD), created=0.0)
            await cloud.state_service.submit(commands.AddUser(user=user))
        try:
            yield cloud
            cloud.state_service.state.validate()
        finally:
            for worker in workers:
                worker.cancel()
            cloud.auth.close()


@pytest.fixture
async def cloud() -> AsyncIterator[Cloud]:
    async with running(FragileStore()) as made:
        yield made


CN = {
    "addInterfaces": [
        {
            "endpointTag": "rob",
            "interfaceTag": "out",
            "interfaceType": "SubscriberConverter",
            "className": "p/T",
        },
        {
            "endpointTag": "c",
            "interfaceTag": "in",
            "interfaceType": "PublisherInterface",
            "className": "p/T",
            "addr": "/in",
        },
    ],
    "addNodes": [{"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": "x.py"}],
}
CX = {"connect": [{"tagA": "rob/out", "tagB": "c/in"}]}


async def wire(robots: FakePeer) -> None:
    assert (await robots.login()).status == 200
    assert await robots.ask("CC", {"containerTag": "c"}) == ()
    assert await robots.ask("CN", CN) == ()
    assert await robots.ask("CX", CX) == ()


# StateService


async def test_nothing_changes_if_it_cannot_be_stored(cloud: Cloud) -> None:
    heard: list[object] = []
    cloud.state_service.listeners.append(heard.append)
    cloud.store.broken = True
    with pytest.raises(StoreError, match="disk full"):
        await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert heard == []
    assert len(cloud.state_service.tables.endpoints) == 0
    cloud.store.broken = False
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert len(heard) == 1


async def test_reports_do_not_suffer_from_a_broken_store(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    cloud.store.broken = True
    cloud.store.free.clear()
    creating = asyncio.ensure_future(
        cloud.state_service.submit(commands.CreateContainer(user="anna", tag="a"))
    )
    await asyncio.sleep(0)
    more = asyncio.ensure_future(cloud.state_service.submit(commands.CreateContainer(user="anna", tag="b")))
    leaving = asyncio.ensure_future(cloud.control_handler.on_gone(robots))
    await asyncio.sleep(0)
    cloud.store.free.set()
    await leaving
    assert not cloud.state_service.tables.is_connected("r1")
    for refused in (creating, more):
        with pytest.raises(StoreError, match="disk full"):
            await refused
    assert len(cloud.state_service.tables.endpoints) == 0
    cloud.store.broken = False


async def test_changes_are_stored_before_anybody_hears_of_them(cloud: Cloud) -> None:
    stored: list[bool] = []
    cloud.state_service.listeners.append(lambda _: stored.append("anna/c" in cloud.store.tables["endpoints"]))
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert stored == [True]


async def test_a_storm_is_stored_at_once(cloud: Cloud) -> None:
    cloud.store.free.clear()
    saves = cloud.store.saves
    made = [
        asyncio.ensure_future(cloud.state_service.submit(commands.CreateContainer(user="anna", tag=f"c{i}")))
        for i in range(100)
    ]
    await asyncio.sleep(0)
    cloud.store.free.set()
    await asyncio.gather(*made)
    assert cloud.store.saves - saves <= 2
    assert len(cloud.store.tables["endpoints"]) == 100


async def test_of_several_commands_only_the_bad_ones_are_refused(cloud: Cloud) -> None:
    outcomes = await cloud.state_service.submit_all(
        [
            commands.CreateContainer(user="anna", tag="c"),
            commands.DestroyContainer(user="anna", tag="none"),
            commands.CreateContainer(user="anna", tag="d"),
        ]
    )
    assert [type(outcome) for outcome in outcomes] == [type(None), NotFoundError, type(None)]
    assert await cloud.state_service.submit_all([]) == []


async def test_a_fault_of_ours_is_no_end(cloud: Cloud, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(MasterError, match="internal error"):
        await cloud.state_service.submit("nonsense")  # type: ignore[arg-type]  # it is refused
    assert "could not apply 'nonsense'" in caplog.text
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))


# Reconciling


async def test_everything_is_said_at_hello_and_changes_after_it(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    assert (await robots.hello()).endpoints == ()
    await wire(robots)
    (spec,) = (await containers.hello()).endpoints
    assert [n.tag for n in spec.nodes] == ["n"]
    assert [c.interface for c in spec.connections] == ["in"]
    address = LinkAddress(machine="m", unix="/run/c")
    await containers.say(
        Status(status=EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING, address=address))
    )
    put = await robots.get(Put)
    while not put.endpoint.links or put.endpoint.links[0].address != address:
        put = await robots.get(Put)
    assert put.endpoint.links[0].dial
    await robots.ask("DC", {"containerTag": "c"})
    assert (await containers.get(Drop)).id == "anna/c"


INTERFACE = {"interfaceType": "PublisherInterface", "className": "std_msgs/String"}


def add(tag: str) -> dict[str, Any]:
    return {"addInterfaces": [{"endpointTag": "c", "interfaceTag": tag, "addr": f"/{tag}", **INTERFACE}]}


async def test_a_task_set_that_takes_patches_is_sent_what_changed(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    containers.features = frozenset({PATCHES})
    await robots.hello()
    await wire(robots)
    (spec,) = (await containers.hello()).endpoints
    desired = DesiredState(spec)
    for tag in ("x", "y"):
        await robots.ask("CN", add(tag))
        patch = (await containers.get(PatchSpec)).patch
        assert [one.tag for one in patch.interfaces] == [tag]
        assert (patch.links, patch.connections, patch.contents) == ((), (), None)
        assert desired.fit(patch) is Fit.NEXT
        desired.patch(patch)
    await robots.ask("CN", {"removeInterfaces": [{"endpointTag": "c", "interfaceTag": "in"}]})
    patch = (await containers.get(PatchSpec)).patch
    assert patch.removed_interfaces == ("in",)
    assert len(patch.removed_links) == len(patch.removed_connections) == 1
    desired.patch(patch)
    assert desired.whole == cloud.state_service.spec("anna/c")


async def test_a_patch_that_did_not_fit_is_followed_by_the_whole(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    containers.features = frozenset({PATCHES})
    await robots.hello()
    await wire(robots)
    await containers.hello()
    await containers.say(SpecWanted(id="anna/c"))
    put = await containers.get(Put)
    assert put.endpoint == cloud.state_service.spec("anna/c")
    await robots.ask("CN", add("x"))
    assert (await containers.get(PatchSpec)).patch.base == put.endpoint.revision
    await containers.say(SpecWanted(id="anna/rob"))
    await containers.say(SpecWanted(id="anna/nothing"))
    await containers.say(SpecWanted(id="anna/c"))
    assert (await containers.get(Put)).endpoint.id == "anna/c", "others are not placed there"


async def test_status_patches_are_added_up_and_a_gap_asks_once(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await wire(robots)
    await containers.hello()
    tables = cloud.state_service.tables

    def status(
        number: int, interfaces: dict[str, bool] | None = None, connections: tuple[int, ...] = ()
    ) -> EndpointStatus:
        return EndpointStatus(
            id="anna/c",
            revision=1,
            state=EndpointState.RUNNING,
            number=number,
            interfaces=interfaces or {},
            connections=connections,
        )

    await containers.say(Status(status=status(4, interfaces={"in": False})))
    await containers.say(
        PatchStatus(patch=StatusPatch(status=status(5, interfaces={"in": True}, connections=(1,))))
    )
    await robots.ask("CN", add("x"))
    assert [one.tag for one in tables.active.by("endpoint", "anna/c")] == ["in"]
    assert [one.connection for one in tables.open_ends.by("endpoint", "anna/c")] == [1]
    for number in (7, 8):
        await containers.say(PatchStatus(patch=StatusPatch(status=status(number, interfaces={"in": False}))))
    assert (await containers.get(StatusWanted)).id == "anna/c"
    await containers.say(Status(status=status(9)))
    await containers.say(PatchStatus(patch=StatusPatch(status=status(10), lost_connections=(1,))))
    await robots.ask("CN", add("y"))
    assert not tables.active
    assert not tables.open_ends
    assert not any(isinstance(left, StatusWanted) for left in drain(containers))


def drain(peer: FakePeer) -> list[ToTaskSet]:
    found = []
    while not peer.inbox.empty():
        found.append(peer.inbox.get_nowait())
    return found


async def test_a_logins_answer_carries_the_spec_and_no_put_precedes_it(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    reply = await robots.login()
    assert reply.endpoint is not None
    assert reply.endpoint.id == "anna/rob"
    assert robots.inbox.empty()


async def test_logins_that_are_refused_say_why(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    wrong = await robots.login(password=client_digest("wrong"))
    assert (wrong.status, wrong.endpoint) == (401, None)
    assert (await robots.login()).status == 200
    twice = await robots.login()
    assert twice.status == 409
    assert "connected already" in twice.reason
    await containers.hello()
    await robots.ask("CC", {"containerTag": "c"})
    assert (await robots.login("c")).status == 409
    cloud.store.broken = True
    assert (await robots.login("other")).status == 503
    cloud.store.broken = False


async def test_a_robot_that_is_connected_elsewhere_is_looked_after(cloud: Cloud) -> None:
    first, second = cloud.robots(), cloud.robots("r2")
    for peer in (first, second):
        await peer.hello()
    await first.login()
    assert (await first.login()).status == 409
    assert first.inbox.empty(), "its own task set probes it by itself"
    assert (await second.login(password=client_digest("wrong"))).status == 401
    assert first.inbox.empty(), "strangers bother nobody"
    assert (await second.login()).status == 409
    assert await first.get(Probe) == Probe(id="anna/rob")
    await first.say(Left(id="anna/rob", reason="it does not answer"))
    await cloud.flush()
    assert (await second.login()).status == 200


async def test_robot_leaving_during_login_is_disconnected(cloud: Cloud) -> None:
    """A robot that leaves while it logs in is not connected for ever."""
    robots = cloud.robots()
    await robots.hello()
    await robots.say(Login(request=1, user="anna", robot="rob", password=PASSWORD))
    await robots.say(Left(id="anna/rob", reason="gone"))
    await robots.get(LoginReply)
    assert (await robots.login()).status == 200


async def test_every_bad_item_is_told_and_the_others_are_done(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await wire(robots)
    errors = await robots.ask(
        "CN",
        {
            "addNodes": [
                {"containerTag": "c", "nodeTag": "good", "pkg": "Test", "exe": "x.py"},
                {"containerTag": "none", "nodeTag": "n", "pkg": "Test", "exe": "x.py"},
                {"containerTag": "c", "nodeTag": "9bad", "pkg": "Test", "exe": "x.py"},
            ],
            "setParam": [{"containerTag": "c", "name": "p", "value": 2**40}],
        },
    )
    assert len(errors) == 3
    assert any("addNodes[2].nodeTag" in error for error in errors)
    assert any("there is no container 'none'" in error for error in errors)
    assert any("32 bits" in error for error in errors)
    assert {n.tag for n in cloud.state_service.spec("anna/c").nodes} == {"n", "good"}
    assert len(await robots.ask("XX", {})) == 1
    assert len(await robots.ask("CN", "nonsense")) == 1
    assert "connect again" in (await robots.ask("CC", {"containerTag": "d"}, robot="stranger"))[0]


async def test_one_message_can_replace_something(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await wire(robots)
    new = {"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": "other.py"}
    old = {"containerTag": "c", "nodeTag": "n"}
    assert await robots.ask("CN", {"addNodes": [new], "removeNodes": [old]}) == ()
    assert [n.exe for n in cloud.state_service.spec("anna/c").nodes] == ["other.py"]


async def test_requests_of_one_channel_are_done_in_order(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await robots.login()
    for number in range(20):
        kind = "CC" if number % 2 == 0 else "DC"
        await robots.say(ClientRequest(request=number, id="anna/rob", type=kind, data={"containerTag": "c"}))
    replies = [await robots.get(ClientReply) for _ in range(20)]
    assert [(r.request, r.errors) for r in replies] == [(number, ()) for number in range(20)]


async def test_faults_go_to_the_robots_of_the_user(cloud: Cloud) -> None:
    one, two, containers = cloud.robots("r1"), cloud.robots("r2"), cloud.containers()
    for peer in (one, two, containers):
        await peer.hello()
    await wire(one)
    await two.login("second")
    await containers.say(Fault(id="anna/c", text="node n died"))
    assert await one.get(Notify) == Notify(id="anna", text="node n died")
    assert await two.get(Notify) == Notify(id="anna", text="node n died")
    await containers.say(Fault(id="anna/c", text="for one", robot="anna/second"))
    assert (await two.get(Notify)).text == "for one"
    await cloud.flush()
    assert not any(isinstance(one.inbox.get_nowait(), Notify) for _ in range(one.inbox.qsize()))


async def test_a_task_set_that_left_hears_nothing_until_it_is_back(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await containers.say(Usage(cpu_s=1.0, memory=2, endpoints={}))
    assert "c1" in cloud.reconciler.usage
    await cloud.control_handler.on_gone(containers)
    assert "c1" not in cloud.reconciler.usage
    while not containers.inbox.empty():
        containers.inbox.get_nowait()
    await robots.ask("CN", {"removeNodes": [{"containerTag": "c", "nodeTag": "n"}]})
    assert containers.inbox.empty()
    again = cloud.containers()
    status = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING)
    (spec,) = (await again.hello(status)).endpoints
    assert spec.nodes == ()
    await cloud.control_handler.on_gone(containers)
    assert cloud.state_service.tables.is_connected("c1"), "the former channel's end is not a loss"


async def test_remade_container_is_put_after_its_predecessor(cloud: Cloud) -> None:
    """A container made again is put when its former self is gone."""
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await robots.ask("DC", {"containerTag": "c"})
    await robots.ask("CC", {"containerTag": "c"})
    drop = await containers.get(Drop)
    assert not any(isinstance(containers.inbox.get_nowait(), Put) for _ in range(containers.inbox.qsize()))
    await containers.say(Gone(id="anna/c", revision=drop.revision))
    put = await containers.get(Put)
    assert put.endpoint.id == "anna/c"
    assert put.endpoint.revision > drop.revision


async def test_logs_are_read_where_the_container_is(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await wire(robots)
    with pytest.raises(TaskSetAwayError, match="cannot be reached"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)
    await containers.hello()
    assert (await cloud.reconciler.read_log("anna/c", "n", 0, 10)).text == "hello"
    with pytest.raises(NotFoundError, match="has no node 'x'"):
        await cloud.reconciler.read_log("anna/c", "x", 0, 10)
    containers.log = LogChunk(request=0, offset=0, error="no logs of an earlier life")
    with pytest.raises(NotFoundError, match="no container 'd'"):
        await cloud.reconciler.read_log("anna/d", "x", 0, 10)
    containers.log = LogChunk(request=0, offset=0, error="no such log")
    with pytest.raises(NotFoundError, match="no such log"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)
    containers.log = LogChunk(request=0, offset=0, text="away")
    with pytest.raises(TaskSetAwayError, match="did not answer"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)


async def test_a_restarted_master_takes_over_what_runs() -> None:
    store = FragileStore()
    address = LinkAddress(machine="m", unix="/run/c")
    running_c = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING, address=address)
    async with running(store) as cloud:
        robots, containers = cloud.robots(), cloud.containers()
        await robots.hello()
        await containers.hello()
        await wire(robots)
        await containers.say(Status(status=running_c))
        await cloud.flush()
        before = cloud.state_service.spec("anna/rob"), cloud.state_service.spec("anna/c")
    async with running(store) as cloud:
        robots, containers = cloud.robots(), cloud.containers()
        status = EndpointStatus(id="anna/rob", revision=before[0].revision, state=EndpointState.RUNNING)
        assert (await robots.hello(status)).endpoints == (before[0],)
        assert (await containers.hello(running_c)).endpoints == (before[1],)
        assert robots.inbox.empty(), "nothing changed, so nothing is to be said"
        assert await robots.ask("CC", {"containerTag": "second"}) == ()
        assert (await containers.get(Put)).endpoint.id == "anna/second"
        twice = await robots.login()
        assert twice.status == 409


async def test_a_request_of_many_parts_is_stored_and_sent_once(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await cloud.flush()
    while not containers.inbox.empty():
        containers.inbox.get_nowait()
    parts = [{"containerTag": "c", "name": f"p{number}", "value": number} for number in range(50)]
    assert await robots.ask("CN", {"setParam": parts}) == ()
    put = await containers.get(Put)
    assert len(put.endpoint.parameters) == 50
    assert put.endpoint.revision == cloud.state_service.spec("anna/c").revision
    assert containers.inbox.empty()
