from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, Protocol, TypedDict, TypeVar, Unpack

import aiohttp
import pytest
from argon2 import PasswordHasher

from rce.config.secret import Secret
from rce.config.settings import LOOPBACK
from rce.control.messages import (
    CONTROL_VERSION,
    Hello,
    LogChunk,
    MachineInfo,
    ReadLog,
    Status,
    Sync,
    TaskSetKind,
    ToTaskSet,
)
from rce.control.model import EndpointStatus
from rce.control_channel.channel import TaskSetChannel
from rce_master.leadership import Fence
from rce_master.master import Master, RunningMaster
from rce_master.quotas import QuotaSettings
from rce_master.settings import MasterSettings
from rce_master.state.settings import StateSettings
from rce_master.store import MemoryStore, Store

T = TypeVar("T")

SECRET = Secret("a secret for the tests")
HASHER = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


class MasterOptions(TypedDict, total=False):
    """Fields of :class:`rce_master.settings.MasterSettings` that tests give."""

    dev: bool
    public_names: tuple[str, ...]
    allowed_origins: tuple[str, ...]
    trusted_proxies: tuple[str, ...]
    state: StateSettings
    quotas: QuotaSettings


class RunSite(Protocol):
    """Runs a master; see :func:`running_site`."""

    def __call__(
        self,
        store: Store | None = None,
        state_dir: Path | None = None,
        *,
        log_in: bool = True,
        fence: Fence | None = None,
        hasher: PasswordHasher = HASHER,
        **options: Unpack[MasterOptions],
    ) -> AbstractAsyncContextManager[Site]: ...


class TaskSet:
    """A task set on a real control channel."""

    def __init__(
        self,
        master: RunningMaster,
        kind: TaskSetKind,
        process: str,
        *,
        machine: MachineInfo | None = None,
        url: str = "",
    ) -> None:
        self.kind = kind
        self.process = process
        self.machine = machine or MachineInfo(name="machine", cores=2)
        self.url = url
        self.endpoints: tuple[EndpointStatus, ...] = ()
        self.features: tuple[str, ...] = ()
        self.inbox: asyncio.Queue[ToTaskSet] = asyncio.Queue()
        self.taken: list[ToTaskSet] = []
        self.log = b""
        self.asked: list[ReadLog] = []
        url = f"ws://{LOOPBACK}:{master.control_port}/"
        self.channel = TaskSetChannel(url, SECRET, self.hello, self.handle)

    def hello(self) -> Hello:
        return Hello(
            version=CONTROL_VERSION,
            kind=self.kind,
            process=self.process,
            machine=self.machine,
            endpoints=self.endpoints,
            url=self.url,
            features=self.features,
        )

    async def handle(self, message: ToTaskSet) -> None:
        if isinstance(message, ReadLog):
            self.asked.append(message)
            text = self.log[message.offset :][: message.limit].decode()
            offset = message.offset + len(text)
            self.channel.send(LogChunk(request=message.request, offset=offset, text=text))
        else:
            self.inbox.put_nowait(message)

    async def get(self, kind: type[T]) -> T:
        async with asyncio.timeout(60):
            while True:
                message = await self.inbox.get()
                self.taken.append(message)
                if isinstance(message, kind):
                    return message

    def report(self, status: EndpointStatus) -> None:
        self.channel.send(Status(status=status))


class Site:
    """A running master and ways to use it."""

    def __init__(self, master: RunningMaster, session: aiohttp.ClientSession) -> None:
        self.master = master
        self.session = session
        self.token = ""

    @property
    def url(self) -> str:
        return self.master.url

    async def api(
        self,
        method: str,
        path: str,
        body: object = None,
        *,
        token: str | None = None,
        status: int = 200,
        **query: str | int,
    ) -> Any:
        """Use the REST API and check the status."""
        headers = {"Authorization": f"Bearer {self.token if token is None else token}"}
        async with self.session.request(
            method, f"{self.url}api/v1{path}", json=body, params=query, headers=headers
        ) as reply:
            text = await reply.text()
            assert reply.status == status, f"{reply.status}: {text}"
            return await reply.json() if text else None

    async def login(self, user: str = "testUser", password: str = "testUser") -> str:
        reply = await self.api("POST", "/login", {"userID": user, "password": password}, token="")
        return str(reply["token"])

    @asynccontextmanager
    async def task_set(
        self,
        kind: TaskSetKind,
        process: str,
        *,
        machine: MachineInfo | None = None,
        url: str = "",
        features: tuple[str, ...] = (),
    ) -> AsyncIterator[TaskSet]:
        made = TaskSet(self.master, kind, process, machine=machine, url=url)
        made.features = features
        task = asyncio.create_task(made.channel.run())
        try:
            await made.get(Sync)
            yield made
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def robots(self, process: str = "r1") -> AbstractAsyncContextManager[TaskSet]:
        return self.task_set(TaskSetKind.ROBOT, process, url=f"ws://{process}:9010/")

    def containers(
        self, process: str = "c1", machine: MachineInfo | None = None
    ) -> AbstractAsyncContextManager[TaskSet]:
        return self.task_set(TaskSetKind.CONTAINER, process, machine=machine)


@asynccontextmanager
async def running_site(
    store: Store | None = None,
    state_dir: Path | None = None,
    *,
    log_in: bool = True,
    fence: Fence | None = None,
    hasher: PasswordHasher = HASHER,
    **options: Unpack[MasterOptions],
) -> AsyncIterator[Site]:
    """Run a master in development mode on free ports, and log in."""
    options.setdefault("dev", True)
    spare = tempfile.TemporaryDirectory(prefix="rce-master-")
    state_dir = state_dir or Path(spare.name)
    settings = MasterSettings(bind=LOOPBACK, http_port=0, control_port=0, state_dir=state_dir, **options)
    ready: asyncio.Future[RunningMaster] = asyncio.get_running_loop().create_future()
    master = Master(settings, SECRET, store or MemoryStore(), hasher=hasher, fence=fence)
    task = asyncio.create_task(master.run(ready.set_result))
    try:
        task.add_done_callback(lambda _: ready.done() or ready.cancel())
        await asyncio.wait([ready])
        if ready.cancelled():
            await task
        async with aiohttp.ClientSession() as session:
            site = Site(ready.result(), session)
            site.token = await site.login() if log_in else ""
            yield site
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        spare.cleanup()


@pytest.fixture
def run_site() -> RunSite:
    return running_site


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    async with running_site() as made:
        yield made
