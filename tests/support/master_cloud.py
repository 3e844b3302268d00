"""The state service, the reconciler and the control handler, with task sets that live in the test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from argon2 import PasswordHasher

from rce.control.exceptions import PeerTimeoutError
from rce.control.logs import LogQuery
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Hello,
    LogChunk,
    Login,
    LoginReply,
    MachineInfo,
    Sync,
    TaskSetKind,
    ToTaskSet,
)
from rce.control.model import EndpointStatus
from rce_master.auth import Authenticator, client_digest
from rce_master.control_handler import ControlHandler
from rce_master.exceptions import SaveTooLargeError, StoreError
from rce_master.reconciler import Reconciler
from rce_master.state import commands
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import User, UserRole
from rce_master.state_service import StateService
from rce_master.store import MemoryStore, Row

M = TypeVar("M")


HASHER = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


PASSWORD = client_digest("secret")


INTERFACE = {"interfaceType": "PublisherInterface", "className": "std_msgs/String"}


class FragileStore(MemoryStore):
    """Breaks when told to, takes so many rows at most as it is told, and notes how often it wrote."""

    def __init__(self) -> None:
        super().__init__()
        self.broken = False
        self.saves = 0
        self.most: int | None = None
        self.free = asyncio.Event()
        self.free.set()

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        await self.free.wait()
        self.saves += 1
        if self.broken:
            raise StoreError("disk full")
        if self.most is not None and len(rows) > self.most:
            raise SaveTooLargeError("too many rows")
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
        self.silence = 0.0
        self.aborts = 0

    def send(self, message: ToTaskSet) -> None:
        self.inbox.put_nowait(message)

    def abort(self) -> None:
        self.aborts += 1

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

    async def save_state(self, id: str, node: str) -> str:  # noqa: A002 - wire name
        return f"{self.process} saves no {id}/{node}"

    async def get(self, kind: type[M]) -> M:
        """Take messages until one of a kind comes."""
        async with asyncio.timeout(60):
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
async def running(store: FragileStore, settings: StateSettings | None = None) -> AsyncIterator[Cloud]:
    cloud = Cloud(await StateService.open(store, settings), store)
    async with asyncio.TaskGroup() as group:
        workers = [
            group.create_task(cloud.state_service.run()),
            group.create_task(cloud.control_handler.run()),
            group.create_task(cloud.reconciler.run()),
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


def add(tag: str) -> dict[str, Any]:
    return {"addInterfaces": [{"endpointTag": "c", "interfaceTag": tag, "addr": f"/{tag}", **INTERFACE}]}


def drain(peer: FakePeer) -> list[ToTaskSet]:
    found = []
    while not peer.inbox.empty():
        found.append(peer.inbox.get_nowait())
    return found
