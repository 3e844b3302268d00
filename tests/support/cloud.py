"""A robot task set with a master and a container that are made of a few lines, all in one process."""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import tempfile
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, Unpack

import msgspec

from rce.config.secret import Secret
from rce.control.messages import (
    TYPED_REQUESTS,
    ClientReply,
    ClientRequest,
    Drop,
    Fault,
    Gone,
    Hello,
    Left,
    Login,
    LoginReply,
    PatchSpec,
    PatchStatus,
    Put,
    SpecWanted,
    Status,
    Sync,
    ToMaster,
    Usage,
)
from rce.control.model import (
    PATCHES,
    ConnectionSpec,
    EndpointKind,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    LinkAddress,
    LinkSpec,
)
from rce.control.observed import ObservedStatus
from rce.control_channel.server import ControlServer
from rce.link import Buffer, Endpoint, Interface, LinkHub, Port
from rce.model.names import EndpointId, InterfaceType
from rce.model.specs import InterfaceSpec
from rce.protocol.requests import read_request, write_request
from rce_robot.app import App
from rce_robot.conversion.pool import ConversionSettings
from rce_robot.settings import RobotSettings, SessionSettings
from support.patches import patch_between

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from rce.control_channel.peer import Peer
    from rce.model.requests import Request

T = TypeVar("T")

SECRET = Secret("secret of the tests")
PASSWORD = "testUser"
DIGEST = hashlib.sha256(PASSWORD.encode()).hexdigest()
EXAMPLES = Path(__file__).parents[2] / "examples"
MACHINE = "here"


class Wiring(TypedDict, total=False):
    """What a spec says of connections."""

    interfaces: tuple[InterfaceSpec, ...]
    links: tuple[LinkSpec, ...]
    connections: tuple[ConnectionSpec, ...]


class RobotOptions(TypedDict, total=False):
    """Fields of :class:`rce_robot.settings.RobotSettings` that tests give."""

    origins: tuple[str, ...]
    login_timeout: float
    user_memory: int
    memory: int
    unauthenticated_per_address: int
    conversion: ConversionSettings


class Signal:
    """Lets a test wait until something that others change is so."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    def set(self) -> None:
        self._event.set()

    async def until(self, condition: Callable[[], T | None]) -> T:
        async with asyncio.timeout(60):
            while not (found := condition()):
                self._event.clear()
                await self._event.wait()
            return found


def content_of(request: ClientRequest) -> Request:
    """What a client asked for, whichever way the task set sent it."""
    return read_request(request.type, request.data) if request.content is None else request.content


class FakeMaster:
    """Lets its users in, testUser if nobody else is named; one spec per robot, which the test changes."""

    def __init__(self) -> None:
        self.changed = Signal()
        self.specs: dict[str, EndpointSpec] = {}
        self.statuses: dict[str, EndpointStatus] = {}
        self.users = {"testUser"}
        self.inside: set[str] = set()
        self.left: list[str] = []
        self.refused_logins = 0
        self._replies: set[asyncio.Future[None]] = set()
        self.gone: list[str] = []
        self.requests: list[tuple[str, str, Any]] = []
        self.usage: Usage | None = None
        self.faults: list[str] = []
        self.answer: Callable[[ClientRequest], Awaitable[tuple[str, ...]]] = self._agree
        self.peer: Peer | None = None
        self.url = ""
        self.in_patches = False
        """Whether it sends what changed of specs, and takes what changed of statuses."""
        self.wanted: list[str] = []
        """Of which robots whole specs were asked for."""
        self.silent = False
        """Whether it answers nothing, like a master that hangs."""

    async def _agree(self, request: ClientRequest) -> tuple[str, ...]:
        return ()

    async def on_hello(self, peer: Peer, hello: Hello) -> None:
        self.peer = peer
        self.url = hello.url
        for status in hello.endpoints:
            self.statuses[status.id] = status
        peer.send(Sync(endpoints=tuple(self.specs[id_] for id_ in self.specs if id_ in self.inside)))
        self.changed.set()

    async def on_gone(self, peer: Peer) -> None:
        self.peer = None
        self.changed.set()

    async def on_message(self, peer: Peer, message: ToMaster) -> None:
        if self.silent:
            return
        match message:
            case Login():
                peer.send(self._login(message))
            case ClientRequest():
                assert (message.content is not None) is self.in_patches
                self.requests.append((message.id, message.type, write_request(content_of(message))))
                task = asyncio.ensure_future(self._reply(peer, message))
                self._replies.add(task)
                task.add_done_callback(self._replies.discard)
            case Status():
                self.statuses[message.status.id] = message.status
            case PatchStatus() | SpecWanted():
                self._take_patching(peer, message)
            case Left():
                self.inside.discard(message.id)
                self.left.append(message.id)
            case Gone():
                self.gone.append(message.id)
            case Usage():
                self.usage = message
            case Fault():
                self.faults.append(message.text)
            case _:
                raise AssertionError(message)
        self.changed.set()

    async def _reply(self, peer: Peer, request: ClientRequest) -> None:
        peer.send(ClientReply(request=request.request, errors=await self.answer(request)))
        self.changed.set()

    def _take_patching(self, peer: Peer, message: PatchStatus | SpecWanted) -> None:
        if isinstance(message, SpecWanted):
            self.wanted.append(message.id)
            peer.send(Put(endpoint=self.specs[message.id]))
            return
        status = message.patch.status
        observed = ObservedStatus(self.statuses[status.id])
        assert status.number == observed.header.number + 1
        observed.patch(message.patch)
        self.statuses[status.id] = observed.whole

    def _login(self, message: Login) -> LoginReply:
        id_ = f"{message.user}/{message.robot}"
        if message.user not in self.users or message.password != DIGEST:
            return LoginReply(request=message.request, status=401, reason="Wrong user or password.")
        if id_ in self.inside:
            self.refused_logins += 1
            return LoginReply(request=message.request, status=409, reason=f"{id_} is already connected.")
        self.inside.add(id_)
        return LoginReply(request=message.request, endpoint=self.spec(id_))

    def spec(self, id_: str) -> EndpointSpec:
        return self.specs.setdefault(id_, EndpointSpec(id=id_, kind=EndpointKind.ROBOT, revision=1))

    def put(self, id_: str, **changes: Unpack[Wiring]) -> None:
        spec = former = self.spec(id_)
        self.specs[id_] = spec = msgspec.structs.replace(spec, revision=spec.revision + 1, **changes)
        if self.peer is not None and self.in_patches:
            self.peer.send(PatchSpec(patch=patch_between(former, spec)))
        elif self.peer is not None:
            self.peer.send(Put(endpoint=spec))

    def drop(self, id_: str, reason: str, *, elsewhere: bool = False) -> None:
        assert self.peer is not None
        self.inside.discard(id_)
        revision = self.specs.pop(id_).revision
        self.peer.send(Drop(id=id_, revision=revision, reason=reason, elsewhere=elsewhere))

    def running(self, id_: str) -> bool:
        status = self.statuses.get(id_)
        return status is not None and status.state is EndpointState.RUNNING


class PeerInterface(Interface):
    """The container's end: notes what comes, answers requests."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.received: asyncio.Queue[bytes] = asyncio.Queue()
        self.active = Signal()
        self.is_active = False
        self.losses = 0
        """How often it lost its last connection."""
        self.answer: Callable[[bytes], Awaitable[Buffer]] = self._echo

    async def _echo(self, payload: bytes) -> Buffer:
        return payload

    async def start(self) -> None:
        pass

    async def close(self) -> None:
        pass

    def receive(self, payload: bytes, *, latched: bool) -> None:
        self.received.put_nowait(payload)

    async def serve(self, payload: bytes) -> Buffer:
        return await self.answer(payload)

    def on_active(self, active: bool) -> None:
        self.is_active = active
        self.losses += not active
        self.active.set()

    async def until_active(self) -> None:
        """Wait until it has a connection that is established."""
        await self.active.until(lambda: self.is_active)


class Cloud:
    """The master, one robot task set, one container."""

    def __init__(
        self, master: FakeMaster, endpoint: Endpoint, ends: dict[str, PeerInterface], address: LinkAddress
    ) -> None:
        self.master = master
        self.ends = ends
        self.ws_url = ""
        self._endpoint = endpoint
        self._address = address
        self._numbers = iter(range(1, 1000))
        self._container = EndpointSpec(id="testUser/cloud", kind=EndpointKind.CONTAINER, revision=1)

    async def wire(
        self, tag: str, type_: str, message_type: str, *, robot: str = "testRobot"
    ) -> PeerInterface:
        """Make an interface of the robot and its complement in the container, joined."""
        kind = InterfaceType.parse(type_)
        id_ = f"testUser/{robot}"
        link = f"link_{robot}"
        number = next(self._numbers)
        peer_tag = f"{robot}_{tag}"
        peer = InterfaceSpec(
            tag=peer_tag,
            type=f"{kind.role.complement.value}Interface",
            message_type=message_type,
            addr=f"/{tag}",
        )
        own = InterfaceSpec(tag=tag, type=type_, message_type=message_type)
        self._container = _grown(
            self._container,
            peer,
            LinkSpec(id=link, peer=id_, token="token", dial=False),
            ConnectionSpec(id=number, link=link, interface=peer_tag, peer_interface=tag),
        )
        spec = _grown(
            self.master.spec(id_),
            own,
            LinkSpec(id=link, peer="testUser/cloud", token="token", dial=True, address=self._address),
            ConnectionSpec(id=number, link=link, interface=tag, peer_interface=peer_tag),
        )
        await self._endpoint.apply(self._container)
        self.master.put(id_, interfaces=spec.interfaces, links=spec.links, connections=spec.connections)
        return self.ends[peer_tag]

    async def joined(
        self, tag: str, type_: str, message_type: str, *, robot: str = "testRobot"
    ) -> PeerInterface:
        """Wire, and wait until the connection is established."""
        end = await self.wire(tag, type_, message_type, robot=robot)
        await end.until_active()
        return end


def _grown(
    spec: EndpointSpec, interface: InterfaceSpec, link: LinkSpec, connection: ConnectionSpec
) -> EndpointSpec:
    links = {item.id: item for item in (*spec.links, link)}
    return msgspec.structs.replace(
        spec,
        revision=spec.revision + 1,
        interfaces=(*spec.interfaces, interface),
        links=tuple(links.values()),
        connections=(*spec.connections, connection),
    )


@asynccontextmanager
async def running_cloud(
    session: SessionSettings | None = None, *, in_patches: bool = False, **settings: Unpack[RobotOptions]
) -> AsyncIterator[Cloud]:
    """Run it all on loopback; ``in_patches`` with a master of this release, else with one of the former."""
    master = FakeMaster()
    master.in_patches = in_patches
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    ends: dict[str, PeerInterface] = {}

    def make(port: Port) -> Interface:
        end = ends[port.spec.tag] = PeerInterface(port)
        return end

    faults: list[str] = []
    async with AsyncExitStack() as stack:
        stack.callback(shutil.rmtree, folder)
        hub = LinkHub(MACHINE)
        stack.push_async_callback(hub.close)
        await hub.listen_unix(folder / "s")
        id_ = EndpointId("testUser", "cloud")
        endpoint = Endpoint(id_, make, hub, on_change=lambda: None, on_fault=faults.append)
        stack.push_async_callback(endpoint.close)
        server = ControlServer(
            SECRET,
            on_hello=master.on_hello,
            on_message=master.on_message,
            on_gone=master.on_gone,
            port=0,
            features=(TYPED_REQUESTS, PATCHES) if in_patches else (),
        )
        await stack.enter_async_context(server)
        cloud = Cloud(master, endpoint, ends, LinkAddress(machine=MACHINE, unix=str(folder / "s")))
        await stack.enter_async_context(running_robots(cloud, server.port, session, **settings))
        yield cloud
    assert not faults


@asynccontextmanager
async def running_robots(
    cloud: Cloud, control_port: int, session: SessionSettings | None = None, **settings: Unpack[RobotOptions]
) -> AsyncIterator[None]:
    """Run a robot task set for the cloud's master."""
    async with robot_task_set(control_port, SECRET, session, **settings) as cloud.ws_url:
        yield


@asynccontextmanager
async def robot_task_set(
    control_port: int,
    secret: Secret,
    session: SessionSettings | None = None,
    **settings: Unpack[RobotOptions],
) -> AsyncIterator[str]:
    """Run a robot task set for a master; yield the URL for robots."""
    ready: asyncio.Queue[str] = asyncio.Queue()
    given = RobotSettings(
        host="127.0.0.1",
        ws_port=0,
        machine=MACHINE,
        usage_interval=0.1,
        session=session or SessionSettings(drain_timeout=1.0),
    )
    app = App(
        master="127.0.0.1",
        control_port=control_port,
        secret=secret,
        packages=(EXAMPLES,),
        settings=replace(given, **settings),
    )
    async with app.started(ready.put_nowait):
        yield await ready.get()
