"""A leading master in which a part fails ends and gives the lead back."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from integration.master.conftest import HASHER, SECRET, TaskSet
from support.etcd import cluster

from rce.aio.tasks import cancel_and_wait, errors_in
from rce.config.settings import LOOPBACK
from rce.config.store_address import EtcdAddress
from rce.control.messages import Sync, TaskSetKind
from rce_master.audit import AuditLog
from rce_master.master import RunningMaster
from rce_master.replicated import ReplicatedMaster
from rce_master.settings import MasterSettings
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.store import EtcdStore

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.timeout(300)]

LEASE_S = 120.0


class BugError(Exception):
    """What no part of a master expects."""


async def test_leader_whose_worker_fails_gives_the_lead_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: AuditLog) -> None:
        raise BugError

    async with AsyncExitStack() as stack:
        etcd = await stack.enter_async_context(cluster(tmp_path / "etcd"))
        client = await stack.enter_async_context(EtcdClient(etcd.endpoints, attempt=20.0))
        address = EtcdAddress(tuple(etcd.endpoints))
        settings = MasterSettings(
            bind=LOOPBACK,
            http_port=0,
            control_port=0,
            state_dir=tmp_path / "master",
            etcd=address,
            lease=LEASE_S,
            name="one",
        )
        ready: asyncio.Future[RunningMaster] = asyncio.get_running_loop().create_future()
        master = ReplicatedMaster(settings, SECRET, hasher=HASHER)
        running = asyncio.create_task(master.run(ready.set_result, lambda _: None))
        stack.push_async_callback(cancel_and_wait, running)
        running.add_done_callback(lambda _: ready.done() or ready.cancel())
        await asyncio.wait([ready])
        assert not running.done()
        task_set = TaskSet(ready.result(), TaskSetKind.CONTAINER, "c1")
        stack.push_async_callback(cancel_and_wait, asyncio.create_task(task_set.channel.run()))
        await task_set.get(Sync)
        store = EtcdStore(client, address.prefix)
        leader = (await store.leadership()).leader
        assert leader is not None
        assert leader.name == "one"
        monkeypatch.setattr(AuditLog, "flush", fail)
        with pytest.raises(BaseExceptionGroup) as caught:
            await running
        assert [type(error) for error in errors_in(caught.value)] == [BugError]
        assert (await store.leadership()).leader is None, "another master need not wait for the lease to end"
