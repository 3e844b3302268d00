"""Requests that no task set would send: the control port answers none with a fault of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from support.fuzzing import Tracebacks, exchange, requests

from rce.config.secret import Secret
from rce.control_channel.server import ControlServer

if TYPE_CHECKING:
    from rce.control.messages import Hello, ToMaster
    from rce.control_channel.peer import Peer

COUNT = 300
SECRET = Secret("the engine's secret")
HASH = "0" * 64
PATHS = ["/", "/{name}", "/contents/{hash}", f"/contents/{HASH}", f"/contents/{HASH}?x={{x}}", "*"]
LOGIN = [
    b"Authorization: Bearer the engine's secret",
    b"Upgrade: websocket",
    b"Connection: Upgrade",
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    b"Sec-WebSocket-Version: 13",
]


async def ignore(*_: Peer | Hello | ToMaster) -> None:
    """Take a task set and what it says."""


async def read(sha256: str, offset: int, count: int) -> tuple[bytes, int] | None:
    return (b"x" * count, 10) if sha256 == HASH else None


async def test_raw_requests_to_the_control_port() -> None:
    async with ControlServer(
        SECRET, on_hello=ignore, on_message=ignore, on_gone=ignore, port=0, contents=read
    ) as server:
        with Tracebacks().watching() as log:
            for request in requests(PATHS, COUNT, LOGIN):
                answers = await exchange(server.port, request)
                assert 500 not in answers, request
                assert not log.found, (request, log.found)
