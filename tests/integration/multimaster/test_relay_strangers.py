"""Links and strangers: a wrong token, false servers, what is said before a proof and how much of it."""

from __future__ import annotations

import asyncio
import json
import struct
import sys
from typing import Any

import pytest
from support.multimaster import STRING, node
from support.relays import linked, sync_of

from rce.ros.core import Core
from rce.ros.multimaster.relay.frames import PROTOCOL
from rce.ros.multimaster.relay.link import UNAUTHENTICATED_PER_ADDRESS
from rce.ros.multimaster.sync import MasterSync


async def test_another_token_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    async with linked(token="wrong") as (cloud, robot, one, other), node("base", robot.uri) as base:
        await base.advertise("said", STRING)
        async with asyncio.timeout(60):
            while "another token" not in caplog.text:
                await asyncio.sleep(0.02)
        assert one._links.connected == other._links.connected == set()
        assert "/said" not in cloud.graph.topic_types


async def until_linked(sync: MasterSync, *names: str) -> None:
    async with asyncio.timeout(60):
        while sync._links.connected != set(names):
            await asyncio.sleep(0.02)


async def test_links_are_taken_after_a_proof_that_is_no_text() -> None:
    """Half a surrogate pair, which JSON can carry and UTF-8 cannot."""
    async with (
        Core(port=0) as cloud,
        Core(port=0) as robot,
        sync_of(cloud, relay_listen=0, relay_addr="127.0.0.1", relay_name="cloud") as one,
    ):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        hello = {"protocol": PROTOCOL, "name": "stranger", "nonce": "ab" * 32, "proof": ""}
        writer.write(greeting("H", hello) + greeting("R", {"proof": "\ud800"}))
        await read_all(reader)
        writer.close()
        async with sync_of(robot, relay_to=(("127.0.0.1", one.relay_port),), relay_name="robot") as other:
            await until_linked(one, "robot")
            await until_linked(other, "cloud")


async def test_dialing_goes_on_after_a_false_server() -> None:
    came: asyncio.Queue[None] = asyncio.Queue()

    async def lie(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        came.put_nowait(None)
        hello = {"protocol": PROTOCOL, "name": "cloud", "nonce": "", "proof": "\ud800"}
        writer.write(greeting("N", {"nonce": "ab" * 32}) + greeting("H", hello))
        await read_all(reader)
        writer.close()

    server = await asyncio.start_server(lie, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, Core(port=0) as robot, sync_of(robot, relay_to=(("127.0.0.1", port),)):
        async with asyncio.timeout(60):
            await came.get()
            await came.get()


async def read_all(reader: asyncio.StreamReader) -> bytes:
    """Read until the connection ends, however it does."""
    try:
        async with asyncio.timeout(60):
            return await reader.read()
    except ConnectionError:
        return b""


def greeting(kind: str, said: dict[str, Any]) -> bytes:
    body = json.dumps(said).encode()
    return struct.pack("<IB", 1 + len(body), ord(kind)) + body


@pytest.mark.parametrize("says", ["nothing", "hello", "hello and a wrong proof", "the old hello"])
async def test_stranger_learns_nothing_but_a_nonce(says: str, caplog: pytest.LogCaptureFixture) -> None:
    """Neither token, nor name, nor topics; before a hello not a byte. It is hung up on within seconds."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        if says == "the old hello":
            writer.write(greeting("H", {"protocol": 1, "name": "stranger", "token": ""}))
        elif says != "nothing":
            writer.write(
                greeting("H", {"protocol": PROTOCOL, "name": "stranger", "nonce": "ab" * 32, "proof": ""})
            )
        if "proof" in says:
            writer.write(greeting("R", {"proof": "00" * 32}))
        answer = await read_all(reader)
        writer.close()
        if says in ("nothing", "the old hello"):
            assert answer == b""
        else:
            length, kind = struct.unpack_from("<IB", answer)
            assert (kind, len(answer)) == (ord("N"), 4 + length), "a challenge and nothing else"
            assert list(json.loads(answer[5:])) == ["nonce"]
        assert "stranger" not in one._links.connected
    assert caplog.text.count("relay link from 127.0.0.1") == 1


async def test_stranger_cannot_send_much(caplog: pytest.LogCaptureFixture) -> None:
    """A large frame is refused by its header."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        writer.write(struct.pack("<IB", 60_000_000, ord("D")))
        assert await read_all(reader) == b""
        writer.close()
    assert "a frame of 60000000 bytes" in caplog.text


async def test_stranger_cannot_say_much(caplog: pytest.LogCaptureFixture) -> None:
    """Many small frames end the connection; none of them is kept."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        writer.write(greeting("N", {"nonce": ""}) * 50)
        assert await read_all(reader) == b""
        writer.close()
    assert caplog.text.count("relay link from 127.0.0.1") == 1


async def test_strangers_are_bounded_in_number() -> None:
    async with linked() as (_, _, one, other):
        async with asyncio.timeout(60):
            while "cloud" not in other._links.connected:
                await asyncio.sleep(0.02)
        connections = [await asyncio.open_connection("127.0.0.1", one.relay_port) for _ in range(60)]
        async with asyncio.timeout(60):
            while one._links._lobby.turned_away < 60 - UNAUTHENTICATED_PER_ADDRESS:
                await asyncio.sleep(0.02)
        assert len(one._links._lobby) <= UNAUTHENTICATED_PER_ADDRESS
        assert one._links.connected == {"robot"}, "who is known continues"
        for _, writer in connections:
            writer.close()


@pytest.mark.parametrize("where", [[], ["--relay-addr", "0.0.0.0"]])
async def test_program_does_not_listen_for_everybody(where: list[str]) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", "from rce.cli.main import main; main()"),
        *("sync", "--relay-listen", "0", *where),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await process.communicate()
    assert process.returncode == 1
    assert b"need a token: give --relay-token" in output
    assert b"Traceback" not in output
