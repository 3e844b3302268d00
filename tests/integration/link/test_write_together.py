"""Several buffers in one go over a real socket, on both event loops."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

import pytest
import uvloop

from rce.buffers import write_together

LARGE = 8 << 20

uvloop.new_event_loop().close()  # the first one of a process opens what stays open


class Sender(asyncio.Protocol):
    def __init__(self) -> None:
        self.paused = 0
        self.writable = asyncio.Event()

    def pause_writing(self) -> None:
        self.paused += 1

    def resume_writing(self) -> None:
        self.writable.set()


@pytest.mark.parametrize("loop", [asyncio.new_event_loop, uvloop.new_event_loop], ids=["asyncio", "uvloop"])
def test_buffers_arrive_in_order_and_protocol_is_paused(
    loop: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def run() -> None:
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        transport, sender = await asyncio.get_running_loop().create_connection(Sender, sock=ours)
        transport.set_write_buffer_limits(high=1 << 16, low=1 << 10)
        write_together(transport, (b"head", memoryview(b"body"), bytearray(b"tail")))
        assert theirs.recv(100) == b"headbodytail"
        assert sender.paused == 0
        write_together(transport, (b"head", memoryview(b"x" * LARGE)))
        assert sender.paused == 1
        got = bytearray()
        while len(got) < 4 + LARGE:
            got += await asyncio.get_running_loop().sock_recv(theirs, 1 << 20)
        assert got == b"head" + b"x" * LARGE
        await sender.writable.wait()
        transport.close()
        theirs.close()

    with asyncio.Runner(loop_factory=loop) as runner:
        runner.run(run())
