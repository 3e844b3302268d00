"""A leading master that ends, or in which a part fails, gives the lead back."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import aiohttp
import pytest
from integration.master.conftest import HASHER, SECRET, Site, TaskSet
from support.engine import until
from support.etcd import cluster
from websockets.asyncio.client import connect

from rce.aio.tasks import cancel_and_wait, errors_in
from rce.config.settings import LOOPBACK
from rce.config.store_address import EtcdAddress
from rce.control import encode
from rce.control.messages import Sync, TaskSetKind
from rce.control_channel.server import ControlServer
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS
from rce.web import serving
from rce_master.audit import AuditLog
from rce_master.master import RunningMaster
from rce_master.replicated import ReplicatedMaster
from rce_master.settings import MasterSettings
from rce_master.store import Row
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.store import EtcdStore

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.timeout(300)]

LEASE_S = 120.0
SHUTDOWN_S = 10.0
CLOSE_S = 90.0
"""How long a task set may take to leave; longer than this module waits for the end of a lease."""


CONTAINER = "testUser/c"


class BugError(Exception):
    """What no part of a master expects."""


@dataclass
class Leader:
    """A master that leads."""

    running: asyncio.Task[None]
    ready: RunningMaster
    store: EtcdStore

    async def name(self) -> str | None:
        """Return the name of the master that leads, as etcd knows it."""
        found = (await self.store.leadership()).leader
        return None if found is None else found.name


@asynccontextmanager
async def leader(folder: Path) -> AsyncIterator[Leader]:
    async with AsyncExitStack() as stack:
        etcd = await stack.enter_async_context(cluster(folder / "etcd"))
        client = await stack.enter_async_context(EtcdClient(etcd.endpoints, attempt=20.0))
        address = EtcdAddress(tuple(etcd.endpoints))
        settings = MasterSettings(
            bind=LOOPBACK,
            http_port=0,
            control_port=0,
            state_dir=folder / "master",
            etcd=address,
            lease=LEASE_S,
            name="one",
            dev=True,
        )
        ready: asyncio.Future[RunningMaster] = asyncio.get_running_loop().create_future()
        master = ReplicatedMaster(settings, SECRET, hasher=HASHER)
        running = asyncio.create_task(master.run(ready.set_result, lambda _: None))
        stack.push_async_callback(cancel_and_wait, running)
        running.add_done_callback(lambda _: ready.done() or ready.cancel())
        await asyncio.wait([ready])
        assert not running.done()
        made = Leader(running, ready.result(), EtcdStore(client, address.prefix))
        assert await made.name() == "one"
        yield made


async def test_leader_whose_worker_fails_gives_the_lead_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: AuditLog) -> None:
        raise BugError

    async with AsyncExitStack() as stack:
        master = await stack.enter_async_context(leader(tmp_path))
        task_set = TaskSet(master.ready, TaskSetKind.CONTAINER, "c1")
        stack.push_async_callback(cancel_and_wait, asyncio.create_task(task_set.channel.run()))
        await task_set.get(Sync)
        monkeypatch.setattr(AuditLog, "flush", fail)
        with pytest.raises(BaseExceptionGroup) as caught:
            await master.running
        assert [type(error) for error in errors_in(caught.value)] == [BugError]
        assert await master.name() is None, "another master need not wait for the lease to end"


async def test_ending_leader_waits_for_no_stream_or_task_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lease ends while a silent task set has yet to leave; a stream ends by itself."""
    monkeypatch.setattr(serving, "SHUTDOWN_S", SHUTDOWN_S)
    patient = replace(DEFAULT_TIMEOUTS, close=CLOSE_S)
    defaults = ControlServer.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "timeouts", patient)
    async with AsyncExitStack() as stack:
        master = await stack.enter_async_context(leader(tmp_path))
        session = await stack.enter_async_context(aiohttp.ClientSession())
        site = Site(master.ready, session)
        headers = {"Authorization": f"Bearer {await site.login()}"}
        events = await stack.enter_async_context(session.get(f"{site.url}api/v1/events", headers=headers))
        await events.content.readuntil(b"hello\n\n")
        task_set = TaskSet(master.ready, TaskSetKind.CONTAINER, "c1")
        url = f"ws://{LOOPBACK}:{master.ready.control_port}/"
        proof = {"Authorization": f"Bearer {SECRET.reveal()}"}
        silent = await connect(url, additional_headers=proof, proxy=None)
        stack.callback(silent.transport.abort)
        await silent.send(encode(task_set.hello()))
        await silent.recv()
        silent.transport.pause_reading()
        master.running.cancel()
        await events.content.read()  # to a proper end

        async def is_given_back() -> bool:
            return await master.name() is None

        await until(is_given_back, timeout=CLOSE_S / 2, what="the lease is given back")
        assert not master.running.done(), "the silent task set is still waited for"
        silent.transport.abort()
        with pytest.raises(asyncio.CancelledError):
            await master.running


async def test_ending_leader_first_finishes_requests_under_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "SHUTDOWN_S", SHUTDOWN_S)
    saving, may_save = asyncio.Event(), asyncio.Event()
    save = EtcdStore.save

    async def save_late(store: EtcdStore, rows: Sequence[Row], term: int) -> None:
        if any(row.key == CONTAINER for row in rows):
            saving.set()
            await may_save.wait()
        await save(store, rows, term)

    async with leader(tmp_path) as master, aiohttp.ClientSession() as session:
        site = Site(master.ready, session)
        site.token = await site.login()
        monkeypatch.setattr(EtcdStore, "save", save_late)
        asking = asyncio.create_task(site.api("POST", "/containers", {"tag": "c"}, status=204))
        async with asyncio.timeout(60):
            await saving.wait()
        master.running.cancel()
        await asyncio.sleep(0.2)
        assert await master.name() == "one"
        may_save.set()
        await asking
        with pytest.raises(asyncio.CancelledError):
            await master.running
        assert await master.name() is None
        assert any(CONTAINER in rows for rows in (await master.store.load()).values())
