"""An engine with ``rce up --tls``, seen by programs that are not of its making: curl, openssl, aiohttp.

Clients get the certificate of a second authority, as of a public one. With the engine's own one for them too:
``test_tls_certificates.py``.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import signal
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest
from support.engine import until
from support.ports import free_ports
from support.tls_engine import BIN, PUBLIC, T, World, await_message, frame, in_world, make_echo, stranger

from rce.ros.core import Core
from rce.tls.folder import CertificateFolder
from rce_client import Connection
from rce_client.exceptions import RefusedError

pytestmark = [pytest.mark.e2e, pytest.mark.needs("curl", "openssl")]

PUBLIC_CERTIFICATE = True
"""For the fixture ``world``."""


@in_world
async def test_curl_with_the_authority_is_served(world: World) -> None:
    code, text = await world.curl(
        "--cacert", world.authority, f"{world.url}?userID=testUser&version=20130902"
    )
    assert (code, json.loads(text)) == (0, {"url": f"wss://127.0.0.1:{world.robots}/"})


@in_world
async def test_certificates_for_clients_and_task_sets_differ(world: World) -> None:
    """A replaced file is used at once for clients."""
    control = f"https://127.0.0.1:{world.control}/"
    code, text = await world.curl("--cacert", world.certificates.authority, control)
    assert code == 56, text
    assert "certificate required" in text
    code, text = await world.curl("--cacert", world.authority, control)
    assert code == 60, text
    file = world.for_clients.certificate(PUBLIC)
    for renewal in range(2):
        for port in (world.http, world.robots):
            place = ("127.0.0.1", port)
            shown = await asyncio.to_thread(ssl.get_server_certificate, place, ca_certs=world.authority)
            assert shown.strip() in file.read_text(), f"port {port} after {renewal} renewals"
        world.for_clients.issue(PUBLIC)


@in_world
async def test_curl_without_the_authority_refuses(world: World) -> None:
    """And the engine's log has one line of it."""
    code, text = await world.curl(world.url)
    assert code == 60, text
    await world.says("HTTPS: a client at 127.0.0.1 was not taken")


@in_world
async def test_robot_by_aiohttp_gets_its_message_back(world: World) -> None:
    async with stranger(world) as socket:
        await make_echo(socket)
        await await_message(socket, "over TLS")
        await socket.send_str(frame("DC", containerTag="echo"))


class OneSegment:
    """A TLS connection that gathers all that it sends until it is told to send."""

    def __init__(self, world: World, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self.tls = world.trusting().wrap_bio(self._in, self._out, server_hostname="127.0.0.1")
        self._reader = reader
        self._writer = writer

    async def complete(self, step: Callable[[], T]) -> T:
        """Do what needs the other end's answers."""
        while True:
            try:
                return step()
            except ssl.SSLWantReadError:
                await self.send()
                self._in.write(await self._reader.read(1 << 16))

    async def send(self) -> None:
        self._writer.write(self._out.read())
        await self._writer.drain()


@in_world
async def test_a_robot_that_sends_much_and_ends_at_once_is_let_go(world: World) -> None:
    """Its end arrives together with frames that have to wait for their turn."""
    login = f"userID=testUser&robotID=hasty&password={hashlib.sha256(b'testUser').hexdigest()}"
    head = (
        f"GET /?{login} HTTP/1.1\r\nHost: 127.0.0.1:{world.robots}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    reader, writer = await asyncio.open_connection("127.0.0.1", world.robots)
    connection = OneSegment(world, reader, writer)
    await connection.complete(connection.tls.do_handshake)
    connection.tls.write(head.encode())
    assert b" 101 " in await connection.complete(lambda: connection.tls.read(4096))
    connection.tls.write(b"\x81\x82\0\0\0\0{}" * 2000)
    with contextlib.suppress(ssl.SSLWantReadError):
        connection.tls.unwrap()
    await connection.send()
    await world.says("robot_left testUser/hasty")
    writer.close()
    assert "Traceback" not in world.output()


@in_world
@pytest.mark.parametrize("port", ["http", "robots", "control"])
async def test_plain_client_is_told_to_use_tls(world: World, port: str) -> None:
    code, text = await world.curl(f"http://127.0.0.1:{getattr(world, port)}/")
    assert (code, text) == (0, "This port speaks TLS only: use https:// or wss://\n")


@in_world
async def test_our_programs_name_the_fault_of_a_wrong_authority(world: World, tmp_path: Path) -> None:
    other = CertificateFolder(tmp_path)
    other.make_authority()
    arguments = ("login", "-u", "testUser", "--password-stdin", world.url)
    code, text = await world.run(BIN / "rce", *arguments, "--authority", other.authority, text="testUser\n")
    assert code == 1
    assert "the server's certificate is not trusted" in text
    assert "--authority FILE" in text
    with pytest.raises(RefusedError, match="--authority FILE"):
        async with Connection(world.url, "testUser", "testUser", "r"):
            pass


@in_world
async def test_login_keeps_the_authority_for_other_commands(world: World) -> None:
    arguments = ("login", "-u", "testUser", "--password-stdin", world.url, "--authority", world.authority)
    code, text = await world.run(BIN / "rce", *arguments, text="testUser\n")
    assert code == 0, text
    code, text = await world.run(BIN / "rce", "user", "list")
    assert code == 0, text
    assert "testUser" in text


@in_world
@pytest.mark.parametrize("way", ["option", "key of the file"])
async def test_rce_ros_connects_with_the_authority(world: World, tmp_path: Path, way: str) -> None:
    file = tmp_path / "robot.config"
    config = {"url": world.url, "userID": "testUser", "password": "testUser", "robotID": "bridged"}
    if way != "option":
        config["authority"] = world.authority
    file.write_text(json.dumps(config))
    async with Core(port=0) as core:
        process = await asyncio.create_subprocess_exec(
            *(str(BIN / "rce-ros"), str(file), "--ros-master-uri", core.uri),
            *(["--authority", world.authority] if way == "option" else []),
            stdout=asyncio.subprocess.PIPE,
            env=world.env,
        )
        assert process.stdout is not None
        async with asyncio.timeout(60):
            assert b"rce-ros ready: robot bridged connected" in await process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        await process.communicate()


@in_world
async def test_station_serves_its_page_in_tls(world: World) -> None:
    (port,) = free_ports(1)
    async with Core(port=0) as core:
        process = await asyncio.create_subprocess_exec(
            *(str(BIN / "rce"), "ui", "--ros-master", core.uri, "--port", str(port), "--tls"),
            *("--certificates", str(world.certificates.path), "--state-dir", str(world.folder / "station")),
            env=world.env,
        )
        url = f"https://127.0.0.1:{port}/"

        async def answers() -> bool:
            assert process.returncode is None
            code, text = await world.curl("--cacert", world.certificates.authority, url)
            return code == 0 and "<html" in text

        await until(answers, timeout=60, what="the station's page")
        process.send_signal(signal.SIGTERM)
        await process.wait()
