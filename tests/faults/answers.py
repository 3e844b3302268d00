"""Answers of etcd that get lost: what was asked for was done, and the one who asked is not told."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass

from faults.machines import Machine
from faults.seeds import generator
from rce.config.store_address import ETCD_PORT

_PIECE = 1 << 16


@dataclass(eq=False)
class LosingProxy:
    """Passes bytes on between masters and a member of etcd, and loses some answers.

    Attributes:
        member: The address of etcd's member.
        share: Of the pieces that the member sends, how many are lost with their connection, 0 to 1.
        lost: How many were lost.
    """

    member: str
    rng: random.Random
    share: float = 0.0
    lost: int = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection of a master until either side ends it."""
        with contextlib.suppress(OSError):
            answers, requests = await asyncio.open_connection(self.member, ETCD_PORT)
            ways = {
                asyncio.create_task(self._pass_on(reader, requests, losing=False)),
                asyncio.create_task(self._pass_on(answers, writer, losing=True)),
            }
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
                requests.transport.abort()
        writer.transport.abort()

    async def _pass_on(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, losing: bool
    ) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_PIECE):
                if losing and self.rng.random() < self.share:
                    self.lost += 1
                    return
                writer.write(data)
                await writer.drain()


@asynccontextmanager
async def losing_proxies(
    machines: Sequence[Machine], host: str, seed: int
) -> AsyncIterator[dict[LosingProxy, str]]:
    """Give a proxy for the member of each machine, with its address; a seed chooses what they lose."""
    proxies: dict[LosingProxy, str] = {}
    async with AsyncExitStack() as stack:
        for machine in machines:
            proxy = LosingProxy(machine.address, generator(seed, f"answers to {machine.name}"))
            server = await stack.enter_async_context(await asyncio.start_server(proxy.serve, host, 0))
            proxies[proxy] = f"{host}:{server.sockets[0].getsockname()[1]}"
        yield proxies
