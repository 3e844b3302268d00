"""The first frames of a link, sent and received by a test itself."""

from __future__ import annotations

import asyncio

from rce.control.model import LinkAddress
from rce.link import (
    LinkLimits,
)
from rce.link.frame_reader import FrameReader
from rce.link.frames import Frame


async def hello(address: LinkAddress, data: bytes) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    if address.unix:
        reader, writer = await asyncio.open_unix_connection(address.unix)
    else:
        reader, writer = await asyncio.open_connection(address.host, address.port)
    writer.write(data)
    return reader, writer


async def answer(reader: asyncio.StreamReader) -> Frame:
    frames = FrameReader(LinkLimits()).feed(await reader.read(100))
    return frames[0]


async def read_on(reader: asyncio.StreamReader) -> bytes:
    try:
        return await reader.read(1_000)
    except ConnectionResetError:
        return b""
