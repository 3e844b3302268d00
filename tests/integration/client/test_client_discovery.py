"""The HTTP step against real servers, good and bad."""

from __future__ import annotations

import asyncio
import ssl
import subprocess
from typing import TYPE_CHECKING

import pytest

from rce_client.discovery import locate
from rce_client.exceptions import RefusedError, UnavailableError

if TYPE_CHECKING:
    from pathlib import Path

    from integration.client.conftest import Door, OpenDoor


async def test_asks_for_user_and_version(door: Door) -> None:
    door.body = '{"url": "ws://here:1/", "current": "20300101"}'
    assert await locate(door.url, "a b", version="20130902") == ("ws://here:1/", False)
    assert door.targets == ["/?userID=a+b&version=20130902&auth=bearer"]


async def test_is_told_that_the_endpoint_takes_a_header(door: Door) -> None:
    door.body = '{"url": "ws://here:1/", "auth": "bearer"}'
    assert await locate(door.url, "u") == ("ws://here:1/", True)


@pytest.mark.parametrize(
    "body", ["", "no json", "[]", "{}", '{"url": 1}', '{"url": "http://x/"}', "x" * 100_000]
)
async def test_an_answer_that_is_none(door: Door, body: str) -> None:
    door.body = body
    with pytest.raises(UnavailableError):
        await locate(door.url, "u")


@pytest.mark.parametrize("url", ["ftp://x/", "nonsense", "http://", "http://x:99999/"])
async def test_a_url_that_is_none(url: str) -> None:
    with pytest.raises(RefusedError):
        await locate(url, "u")


async def serve(answer: bytes) -> asyncio.Server:
    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)
        writer.close()
        await writer.wait_closed()

    return await asyncio.start_server(handle, "127.0.0.1", 0)


@pytest.mark.parametrize(
    "answer",
    [b"", b"SSH-2.0-x\r\n", b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\n{}", b"HTTP/1.1 200 OK\r\n"],
)
async def test_a_server_that_is_no_master(answer: bytes) -> None:
    async with await serve(answer) as server:
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(UnavailableError):
            await locate(f"http://127.0.0.1:{port}/", "u", timeout=5)


async def test_nobody_there() -> None:
    async with await serve(b"") as server:
        port = server.sockets[0].getsockname()[1]
    with pytest.raises(UnavailableError):
        await locate(f"http://127.0.0.1:{port}/", "u")


async def test_https(open_door: OpenDoor, tmp_path: Path) -> None:
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    subprocess.run(
        f"openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 1 -keyout {key}"
        f" -out {cert} -subj /CN=localhost -addext subjectAltName=IP:127.0.0.1".split(),
        check=True,
        capture_output=True,
    )
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(cert, key)
    async with open_door(server) as door:
        door.body = '{"url": "wss://here:1/"}'
        with pytest.raises(RefusedError, match="certificate"):
            await locate(door.url, "u")
        assert await locate(door.url, "u", tls=ssl.create_default_context(cafile=str(cert))) == (
            "wss://here:1/",
            False,
        )
        door.body = '{"url": "ws://here:1/"}'
        with pytest.raises(RefusedError, match="sends robots to ws://here:1/, which is not encrypted"):
            await locate(door.url, "u", tls=ssl.create_default_context(cafile=str(cert)))
