"""One remote master in a synchronization, as it goes and comes back."""

from __future__ import annotations

import asyncio

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
