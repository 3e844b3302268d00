"""What one user sends is handled in turns; what takes long is handled in other processes."""

from __future__ import annotations

import asyncio
import gc
import json
import os
import struct
from typing import TYPE_CHECKING, Any

import psutil
import pytest
from support.cloud import DIGEST, running_cloud
from support.engine import until
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State

from rce_robot.conversion.pool import ConversionSettings
from rce_robot.doors.client.session import Session
from rce_robot.doors.client.websocket import RobotSocket
from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from support.cloud import Cloud

STRING = "std_msgs/String"
PATIENT = SessionSettings(ping_interval=None, drain_timeout=1.0)


def dial(cloud: Cloud, user: str, robot: str) -> connect:
    query = f"userID={user}&robotID={robot}&password={DIGEST}"
    return connect(f"{cloud.ws_url}?{query}", proxy=None, compression=None, max_size=None)


def say(msg: str, tag: str = "tag") -> str:
    return f'{{"type":"DM","data":{{"iTag":"{tag}","type":"{STRING}","msgID":"nil","msg":{msg}}}}}'


async def errors(socket: ClientConnection, count: int) -> list[str]:
    found: list[str] = []
    async with asyncio.timeout(60):
        while len(found) < count:
            message = json.loads(await socket.recv())
            if message["type"] == "ER":
                found.append(message["data"])
    return found


def open_doors() -> list[RobotSocket]:
    """The server's ends of all robots' connections."""
    doors = [each for each in gc.get_objects() if issubclass(type(each), RobotSocket)]
    return [each for each in doors if each.protocol.state is State.OPEN]


def workers() -> list[psutil.Process]:
    found = []
    for process in psutil.Process().children(recursive=True):
        try:
            if "rce_robot.conversion.worker" in process.cmdline():
                found.append(process)
        except psutil.Error:
            continue
    return found


async def test_many_small_frames_of_one_user_leave_room_for_another() -> None:
    """20,000 frames come in one piece; a message of another user passes before half of them are handled."""
    frames = (struct.pack("!BB4x", 0x81, 0x80 | 2) + b"{}") * 20_000
    async with running_cloud(PATIENT) as cloud:
        cloud.master.users.add("flood")
        end = await cloud.joined("tag", "SubscriberConverter", STRING)
        async with dial(cloud, "flood", "f") as flood, dial(cloud, "testUser", "testRobot") as good:
            await end.until_active()
            (door,) = [each for each in open_doors() if each._user == "flood"]
            door.data_received(frames)  # the network would bring it in pieces
            await good.send(say('{"data":"hello"}'))
            async with asyncio.timeout(30):
                await end.received.get()
            assert door._input_bytes > len(frames) / 2
            async with asyncio.timeout(60):
                await (await good.ping())
            flood.transport.abort()  # it has not read its errors, and would wait for the end


async def test_long_requests_that_are_read_in_steps_keep_their_order() -> None:
    """A message of another robot passes before all are read; what comes behind a request waits for it."""
    item = {"endpointTag": "r", "interfaceType": "PublisherConverter", "className": STRING}
    items = [{**item, "interfaceTag": f"i{number}"} for number in range(500)]
    async with running_cloud(PATIENT) as cloud:
        end = await cloud.joined("tag", "SubscriberConverter", STRING)
        requests = cloud.master.requests
        async with dial(cloud, "testUser", "long") as long, dial(cloud, "testUser", "testRobot") as good:
            await end.until_active()
            for number in range(100):
                binary = f"{number:032d}"
                more = (
                    {"setParam": [{"containerTag": "c", "name": "p", "value*": binary}]} if number % 2 else {}
                )
                await long.send(json.dumps({"type": "CN", "data": {"addInterfaces": items, **more}}))
                if more:
                    await long.send(binary.encode())
                await long.send(json.dumps({"type": "DC", "data": {"containerTag": f"c{number}"}}))
            await good.send(say('{"data":"hello"}'))
            async with asyncio.timeout(60):
                await end.received.get()
            assert sum(kind == "DC" for _, kind, _ in requests) < 100
            await until(lambda: len(requests) == 200, timeout=120, what="all requests are there")
        assert [kind for _, kind, _ in requests] == ["CN", "DC"] * 100
        assert {len(data["addInterfaces"]) for _, kind, data in requests if kind == "CN"} == {500}


async def test_pings_of_a_robot_that_does_not_read_are_not_kept() -> None:
    """The newest is answered when it reads again."""
    async with running_cloud(PATIENT) as cloud, dial(cloud, "testUser", "robot") as robot:
        robot.transport.pause_reading()
        ping = struct.pack("!BB4x125x", 0x89, 0x80 | 125)
        for _ in range(60):
            robot.transport.write(ping * 1000)
            await robot.drain()
        robot.transport.write(struct.pack("!BB4x", 0x82, 0x80 | 40) + b"a" * 40)  # a value of no message
        (door,) = open_doors()
        assert isinstance(door.receiver, Session)
        stream = door.receiver._stream
        await until(lambda: stream.pending_bytes > 0, timeout=180, what="all pings were handled")
        assert door.transport.get_write_buffer_size() < 1 << 20
        robot.transport.resume_reading()
        await (await robot.ping(b"newest"))


async def test_large_message_uses_a_process_that_ends_when_idle() -> None:
    """A large message takes a process that ends when it has nothing to do."""
    async with running_cloud(PATIENT, conversion=ConversionSettings(idle=0.1)) as cloud:
        end = await cloud.wire("tag", "SubscriberConverter", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            await end.until_active()
            assert not workers()
            text = "\xe4" * 1_000_000
            await robot.send(say(json.dumps({"data": text})))
            await robot.send(say('{"data":"after"}'))
            async with asyncio.timeout(60):
                first, second = await end.received.get(), await end.received.get()
            assert first[4:] == text.encode()
            assert second[4:] == b"after"
            await until(lambda: not workers(), what="the process ends")


async def test_a_string_of_ten_megabytes_passes_in_both_directions() -> None:
    async with running_cloud(PATIENT) as cloud:
        inwards = await cloud.wire("in", "SubscriberConverter", STRING)
        outwards = await cloud.wire("out", "PublisherConverter", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            await inwards.active.until(lambda: inwards.is_active and outwards.is_active)
            for text in ("x" * 10_000_000, ',[{"' * 2_500_000):
                await robot.send(say(json.dumps({"data": text}), "in"))
                async with asyncio.timeout(60):
                    payload = await inwards.received.get()
                    assert payload[4:].decode() == text
                    outwards.port.send(payload)
                    while (message := json.loads(await robot.recv()))["type"] != "DM":
                        pass
                assert message["data"]["msg"]["data"] == text


async def test_what_is_too_much_is_refused_with_what_to_do() -> None:
    async with running_cloud(PATIENT) as cloud:
        end = await cloud.wire("tag", "SubscriberConverter", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            await end.until_active()
            bombs = {
                "[" + "[]," * 5_000_000 + "[]]": "tag: a message of 5000010 objects, lists and members",
                "{" + ",".join(f'"k{n}":1' for n in range(300_000)) + "}": "tag: a message of 300",
                "[" * 100_000 + "]" * 100_000: "tag: nested deeper than",
                "[" + "1," * 3_000_000 + "1]": "tag: a message of 30000",
            }
            for bomb in bombs:
                await robot.send(say(bomb))
            await robot.send("x" * (16 * 2**20 + 1))
            await robot.send(say("[" + "[]," * 100_000 + "[]]", "nowhere"))
            found = sorted(await errors(robot, len(bombs) + 2))
            for text in (*bombs.values(), "a text frame of 16777217", "nowhere: robot testRobot has no such"):
                assert any(error.startswith(text) for error in found), (text, [e[:200] for e in found])


async def test_a_conversion_that_takes_too_long_is_ended() -> None:
    async with running_cloud(PATIENT, conversion=ConversionSettings(timeout=0.0)) as cloud:
        end = await cloud.wire("tag", "SubscriberConverter", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            await end.until_active()
            await robot.send(say(json.dumps({"data": "\xe4" * 1_000_000})))
            assert await errors(robot, 1) == ["tag: converting the message takes more than 0 s"]
            await until(lambda: not workers(), what="the worker is gone")
            await robot.send(say('{"data":"after"}'))
            async with asyncio.timeout(30):
                assert (await end.received.get())[4:] == b"after"


async def test_a_conversion_that_needs_too_much_memory_is_refused() -> None:
    async with running_cloud(PATIENT, conversion=ConversionSettings(memory=160 << 20)) as cloud:
        end = await cloud.wire("tag", "PublisherConverter", "std_msgs/Int8MultiArray")
        async with dial(cloud, "testUser", "testRobot") as robot:
            await end.until_active()
            size = 32_000_000
            end.port.send(struct.pack("<III", 0, 0, size) + os.urandom(size))
            (error,) = await errors(robot, 1)
            assert error == "tag: converting the message takes more than 160 MiB of memory"
            end.port.send(struct.pack("<III", 0, 0, 1) + b"\x07")
            data: Any = None
            async with asyncio.timeout(30):
                while data is None:
                    message = json.loads(await robot.recv())
                    data = message["data"] if message["type"] == "DM" else None
            assert data["msg"]["data"] == [7]


async def test_messages_that_are_compressed_are_refused() -> None:
    """A server that offers no compression cannot be made to inflate anything."""
    async with running_cloud(PATIENT) as cloud:
        query = f"userID=testUser&robotID=testRobot&password={DIGEST}"
        async with connect(f"{cloud.ws_url}?{query}", proxy=None, compression="deflate") as robot:
            assert not robot.protocol.extensions
            robot.transport.write(struct.pack("!BB", 0xC1, 0x80 | 2) + bytes(4) + b"{}")
            await asyncio.wait_for(robot.wait_closed(), 10)
            assert robot.close_code == 1002


async def test_a_large_message_in_fragments_is_put_together() -> None:
    """Fragments of all sizes, and a ping between them; a small message after it comes after it."""
    async with running_cloud(PATIENT) as cloud:
        end = await cloud.joined("tag", "SubscriberConverter", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            await end.until_active()
            text = "x" * 5_000_000
            whole = say(json.dumps({"data": text}))

            async def pieces() -> AsyncIterator[str]:
                yield whole[:10]
                await robot.ping()
                yield whole[10:100_000]
                yield whole[100_000:4_500_000]
                yield whole[4_500_000:]

            await robot.send(pieces())
            await robot.send(say('{"data":"after"}'))
            async with asyncio.timeout(60):
                first, second = await end.received.get(), await end.received.get()
            assert first[4:] == text.encode()
            assert second[4:] == b"after"


async def test_fragments_over_the_longest_message_end_the_connection() -> None:
    limit = 1 << 20

    async def pieces() -> AsyncIterator[bytes]:
        while True:
            yield bytes(100_000)

    async with (
        running_cloud(SessionSettings(ping_interval=None, max_message=limit)) as cloud,
        dial(cloud, "testUser", "testRobot") as robot,
    ):
        with pytest.raises(ConnectionClosed):
            await asyncio.wait_for(robot.send(pieces()), 60)
        await asyncio.wait_for(robot.wait_closed(), 60)
        assert robot.close_code == 1009


async def test_a_large_text_that_is_not_utf8_ends_the_connection() -> None:
    async with running_cloud(PATIENT) as cloud, dial(cloud, "testUser", "testRobot") as robot:
        await robot.send(b'"' + b"x" * 3_000_000 + b'\xff"', text=True)
        await asyncio.wait_for(robot.wait_closed(), 60)
        assert robot.close_code == 1007
