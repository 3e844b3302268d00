"""One remote master in a synchronization, as it goes and comes back."""

from __future__ import annotations

import asyncio

import pytest

from rce.ros.errors import RosError
from rce.ros.multimaster.heartbeat import ZERO
from rce.ros.multimaster.peer_table import Neighbour
from rce.ros.multimaster.remote import LOOK_AGAIN, Remote
from rce.ros.xmlrpc import RpcClient

MASTER = Neighbour("far", "http://far:11311/", "http://far:11611/", "/master_discovery", True, ZERO, ZERO)


class SlowRemote(Remote):
    """Takes back slowly, as a busy master lets it."""

    def __init__(self) -> None:
        super().__init__(MASTER, RpcClient())
        self.synchronized: asyncio.Queue[None] = asyncio.Queue()
        self.releasing = asyncio.Event()
        self.released = asyncio.Event()

    async def synchronize(self, *, again: bool = False) -> None:
        del again
        self.synchronized.put_nowait(None)

    async def release(self) -> None:
        self.releasing.set()
        await self.released.wait()


async def test_master_that_is_back_at_once_is_synchronized_at_once() -> None:
    remote = SlowRemote()
    running = asyncio.create_task(remote.run())
    async with asyncio.timeout(LOOK_AGAIN / 2):
        await remote.synchronized.get()
        remote.leave()
        await remote.releasing.wait()
        remote.update(MASTER)
        remote.released.set()
        await remote.synchronized.get()
    running.cancel()
    await asyncio.wait([running])


class FaultyRemote(SlowRemote):
    """Cannot be synchronized, for reasons that are given."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__()
        self._faults = faults

    async def synchronize(self, *, again: bool = False) -> None:
        if self._faults:
            raise RosError(self._faults.pop(0))
        await super().synchronize(again=again)


async def test_a_fault_that_lasts_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rce.ros.multimaster.remote.RETRY", 0.001)
    remote = FaultyRemote(["no route", "no route", "no route", "no answer", "no route"])
    running = asyncio.create_task(remote.run())
    await asyncio.wait_for(remote.synchronized.get(), 20)
    running.cancel()
    await asyncio.wait([running])
    assert caplog.messages == ["master far: no route", "master far: no answer", "master far: no route"]
