"""A link with a limited rate between two programs."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

from support.go_between import GoBetween

PIECE = 16 << 10
"""So that little is on the way at a time."""


class SlowLink(GoBetween):
    """Passes connections on with a limited rate, in one direction or both.

    Attributes:
        hangs: Whether nothing is passed on, while the kernel still takes what comes.
    """

    def __init__(self, url: str, *, up: float = 0.0, down: float = 0.0) -> None:
        parts = urlsplit(url)
        assert parts.hostname is not None
        super().__init__((parts.hostname, parts.port or 80), PIECE)
        self._up, self._down = up, down
        self.hangs = False

    @property
    def url(self) -> str:
        return f"ws://{self.endpoint}/"

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with self.to_server() as (there, to), asyncio.TaskGroup() as group:
            group.create_task(self._pass(reader, to, self._up))
            group.create_task(self._pass(there, writer, self._down))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, rate: float) -> None:
        while piece := await reader.read(PIECE):
            if rate:
                await asyncio.sleep(len(piece) / rate)
            while self.hangs:
                await asyncio.sleep(0.05)
            writer.write(piece)
            await writer.drain()
        raise ConnectionResetError
