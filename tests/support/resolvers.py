"""A name server that answers when a test says so, and programs that ask it."""

from __future__ import annotations

import asyncio
import random
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import cast

NO_SUCH_NAME = 0x8183
"""Flags of an answer: the name does not exist."""


class SilentResolver(asyncio.DatagramProtocol):
    """Keeps every question until :meth:`refuse_all`; then says of every name that it does not exist."""

    def __init__(self) -> None:
        self.questions: list[tuple[bytes, tuple[str, int]]] = []
        self.asked = asyncio.Event()
        self.names: list[str] = []
        self._refuses = False
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)  # both loops' only behave like one

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.names.append(_name(data))
        self.questions.append((data, addr))
        if self._refuses:
            self.refuse_all()
        self.asked.set()

    def refuse_all(self) -> None:
        self._refuses = True
        for data, addr in self.questions:
            header = data[:2] + NO_SUCH_NAME.to_bytes(2, "big") + data[4:6] + bytes(6)
            end = (
                12 + data[12:].index(0) + 5
            )  # the question: labels, type and class; what follows is left out
            self._transport.sendto(header + data[12:end], addr)
        self.questions.clear()


def _name(question: bytes) -> str:
    labels, position = [], 12
    while length := question[position]:
        labels.append(question[position + 1 : position + 1 + length].decode())
        position += 1 + length
    return ".".join(labels)


@asynccontextmanager
async def silent_resolver(folder: Path) -> AsyncIterator[tuple[SilentResolver, list[str]]]:
    """Run a resolver; yields it and the words before a command that lets a program ask it. Needs root."""
    address = f"127.{random.randint(1, 254)}.{random.randint(1, 254)}.{random.randint(2, 254)}"
    config = folder / "resolv.conf"
    config.write_text(f"nameserver {address}\noptions timeout:30 attempts:5\n")
    loop = asyncio.get_running_loop()
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((address, 53))
    sock.setblocking(False)
    transport, resolver = await loop.create_datagram_endpoint(SilentResolver, sock=sock)
    script = 'mount --bind "$0" /etc/resolv.conf && exec "$@"'
    try:
        yield resolver, ["unshare", "-m", "--propagation", "private", "sh", "-c", script, str(config)]
    finally:
        transport.close()
