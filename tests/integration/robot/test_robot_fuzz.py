"""Handshakes that no client would send: the robot endpoint answers none with a fault of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.cloud import DIGEST
from support.fuzzing import Tracebacks, exchange, requests

if TYPE_CHECKING:
    from support.cloud import Cloud

COUNT = 300
PATHS = [
    "/",
    f"/?userID=testUser&robotID={{robot}}&password={DIGEST}",
    "/?userID={user}&robotID={robot}&password={password}",
    "*",
    "http://[::1",
]
UPGRADE = [
    b"Upgrade: websocket",
    b"Connection: Upgrade",
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    b"Sec-WebSocket-Version: 13",
]


async def test_raw_handshakes(cloud: Cloud) -> None:
    port = int(cloud.ws_url.rpartition(":")[2].rstrip("/"))
    with Tracebacks().watching() as log:
        for request in requests(PATHS, COUNT, UPGRADE):
            answers = await exchange(port, request)
            assert 500 not in answers, request
            assert not log.found, (request, log.found)


@pytest.mark.parametrize(
    ("path", "extra", "status"),
    [
        ("http://[::1", b"", 400),
        ("/?userID=%ff&robotID=r&password=x", b"", 400),
        ("/", b"Upgrade: websocket\r\n", 426),
        ("/", b"Origin: http://a\r\nOrigin: http://b\r\n", 403),
        ("/", b"Origin: http://x\r\n", 403),  # a name that leads here (DNS rebinding): it equals Host
    ],
)
async def test_handshakes_that_are_refused(cloud: Cloud, path: str, extra: bytes, status: int) -> None:
    port = int(cloud.ws_url.rpartition(":")[2].rstrip("/"))
    head = b"\r\n".join([f"GET {path} HTTP/1.1".encode(), b"Host: x", *UPGRADE])
    with Tracebacks().watching() as log:
        assert await exchange(port, head + b"\r\n" + extra + b"\r\n", whole=True) == [status]
        assert not log.found


async def test_frames_before_the_handshake_is_answered(cloud: Cloud) -> None:
    port = int(cloud.ws_url.rpartition(":")[2].rstrip("/"))
    head = b"\r\n".join([b"GET / HTTP/1.1", b"Host: x", *UPGRADE])
    with Tracebacks().watching() as log:
        assert await exchange(port, head + b"\r\n\r\n" + b"\xff" * 100, whole=True) == []
        assert not log.found
