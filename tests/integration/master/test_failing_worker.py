"""A fault in one part of a master ends it as a whole, so that another one replaces it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
from integration.master.conftest import HASHER, SECRET, TaskSet

from rce.aio.tasks import cancel_and_wait, errors_in
from rce.config.settings import LOOPBACK
from rce.control.messages import MachineInfo, Sync, TaskSetKind
from rce_master.audit import AuditLog
from rce_master.exceptions import StoreError
from rce_master.master import Master, RunningMaster
from rce_master.settings import MasterSettings
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.store import MemoryStore


class BugError(Exception):
    """What no part of a master expects."""


@asynccontextmanager
async def with_task_set(folder: Path) -> AsyncIterator[tuple[asyncio.Task[None], RunningMaster]]:
    """Run a master with a connected task set."""
    settings = MasterSettings(bind=LOOPBACK, http_port=0, control_port=0, state_dir=folder)
    ready: asyncio.Future[RunningMaster] = asyncio.get_running_loop().create_future()
    running = asyncio.create_task(
        Master(settings, SECRET, MemoryStore(), hasher=HASHER).run(ready.set_result)
    )
    async with AsyncExitStack() as stack:
        stack.push_async_callback(cancel_and_wait, running)
        task_set = TaskSet(await ready, TaskSetKind.CONTAINER, "c1", machine=MachineInfo(name="m", cores=2))
        stack.push_async_callback(cancel_and_wait, channel := asyncio.create_task(task_set.channel.run()))
        await task_set.get(Sync)
        assert not channel.done()
        yield running, ready.result()


async def ends_with_bug(running: asyncio.Task[None]) -> None:
    with pytest.raises(BaseExceptionGroup) as caught:
        async with asyncio.timeout(60):
            await running
    assert [type(error) for error in errors_in(caught.value)] == [BugError]


async def test_fault_of_a_listener_ends_the_master(tmp_path: Path) -> None:
    def fail(_: Changes) -> None:
        raise BugError

    async with with_task_set(tmp_path) as (running, master):
        master.state_service.listeners.append(fail)
        with pytest.raises(StoreError, match="ends"):
            await master.state_service.submit(commands.SetDraining(machine="m", draining=True))
        await ends_with_bug(running)
        with pytest.raises(StoreError, match="ends"):
            await master.state_service.submit(commands.Tick())


async def test_fault_of_another_part_ends_the_master(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with with_task_set(tmp_path) as (running, _):

        def fail(_: AuditLog) -> None:
            raise BugError

        monkeypatch.setattr(AuditLog, "flush", fail)
        await ends_with_bug(running)
