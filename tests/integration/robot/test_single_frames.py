"""Forwarders' messages in one frame for robots that ask for it, in two for all others."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pytest
from support.cloud import DIGEST
from websockets.asyncio.client import connect

from rce.protocol.single import MAX_PAYLOAD

if TYPE_CHECKING:
    from integration.robot.conftest import Robot
    from support.cloud import Cloud
    from websockets.asyncio.client import ClientConnection

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"
SIZES = (0, 1, 60, 61, 62, 63, 64, 65, 125, 126, 16_000, 16_384, 65_000, 65_470, 65_504, 1_000_000)


@pytest.fixture
async def single(cloud: Cloud, robot_of: type[Robot]) -> AsyncIterator[Robot]:
    """A robot that asked for messages in one frame, and was granted it."""
    async with asking(cloud, "single-frame") as socket:
        yield robot_of(socket)


@asynccontextmanager
async def asking(cloud: Cloud, features: str) -> AsyncIterator[ClientConnection]:
    query = urlencode(
        {"userID": "testUser", "robotID": "testRobot", "password": DIGEST, "features": features}
    )
    async with connect(f"{cloud.ws_url}?{query}", proxy=None, compression=None, max_size=None) as socket:
        assert socket.response is not None
        assert socket.response.headers["RCE-Features"] == features
        yield socket


def frame_of(tag: str, cls: str, payload: bytes, msg_id: str = "nil") -> bytes:
    header = json.dumps({"iTag": tag, "type": cls, "msgID": msg_id}).encode()
    return struct.pack("!BH", 1, len(header)) + header + payload


def read(frame: bytes) -> tuple[dict[str, Any], bytes]:
    mark, size = struct.unpack_from("!BH", frame)
    assert mark == 1
    return json.loads(frame[3 : 3 + size]), frame[3 + size :]


async def test_messages_of_all_sizes_to_the_robot(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("hear", "PublisherForwarder", STRING)
    await single.get("ST")
    for size in SIZES:
        end.port.send(bytes(size))
        header, payload = read(await single.binary())
        assert header == {"iTag": "hear", "type": STRING, "msgID": "nil"}
        assert payload == bytes(size)


async def test_messages_of_all_sizes_from_the_robot(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("say", "SubscriberForwarder", STRING)
    for size in SIZES:
        await single.socket.send(frame_of("say", STRING, bytes(size)))
        assert await end.received.get() == bytes(size)


async def test_latched_message_names_its_source_in_the_header(cloud: Cloud, robot_of: type[Robot]) -> None:
    end = await cloud.joined("hear", "PublisherForwarder", STRING)
    for payload in (b"first", b"last"):
        end.port.send(payload, latched=True)
    async with asking(cloud, "latch,single-frame") as socket:
        robot = robot_of(socket)
        await robot.get("ST")
        header, payload = read(await robot.binary())
        assert payload == b"last"
        sources = (await robot.get("LT"))["sources"]
        assert sources == [header["latch"]]


async def test_message_in_fragments_is_put_together(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("say", "SubscriberForwarder", STRING)
    frame = frame_of("say", STRING, b"in parts")
    await single.socket.send([frame[:1], frame[1:9], b"", frame[9:]])
    assert await end.received.get() == b"in parts"


async def test_two_frames_may_come_from_the_robot_too(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("say", "SubscriberForwarder", STRING)
    id_ = "0123456789abcdef" * 2
    await single.say("say", STRING, id_, key="msg*")
    await single.socket.send(frame_of("say", STRING, b"between"))
    await single.socket.send(id_.encode() + b"in two")
    assert [await end.received.get() for _ in range(2)] == [b"between", b"in two"]


async def test_service_calls_in_both_directions(cloud: Cloud, single: Robot) -> None:
    ask = await cloud.joined("ask", "ServiceProviderForwarder", ECHO)
    serve = await cloud.joined("serve", "ServiceClientForwarder", ECHO)

    async def answer(payload: bytes) -> bytes:
        return payload + payload

    ask.answer = answer
    for _ in range(2):
        await single.get("ST")
    await single.socket.send(frame_of("ask", ECHO, b"twice", 'id "1"'))
    header, payload = read(await single.binary())
    assert (header["iTag"], header["msgID"], payload) == ("ask", 'id "1"', b"twicetwice")
    call = asyncio.create_task(serve.port.call(b"request"))
    header, payload = read(await single.binary())
    assert (header["iTag"], payload) == ("serve", b"request")
    await single.socket.send(frame_of("serve", ECHO, b"response", header["msgID"]))
    assert await call == b"response"


async def test_converters_stay_as_they_are(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("hear", "PublisherConverter", STRING)
    end.port.send(struct.pack("<I", 5) + b"hello")
    assert (await single.get("DM"))["msg"] == {"data": "hello"}


async def test_what_is_wrong_is_told_and_harms_nothing_else(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("say", "SubscriberForwarder", STRING)
    await cloud.joined("shape", "SubscriberConverter", STRING)
    for frame, words in (
        (b"\x01", "at least 3 bytes"),
        (b"\x01\xff\xff", "longer than the limit"),
        (b"\x01\x00\x02{}", "data.iTag: is missing"),
        (frame_of("nowhere", STRING, b"x"), "nowhere"),
        (frame_of("say", "std_msgs/Int8", b"x"), "say: "),
        (frame_of("shape", STRING, b"x"), "shape: "),
        (b"\x02" + b"0" * 40, "32 hexadecimal characters"),
    ):
        await single.socket.send(frame)
        assert words in await single.get("ER")
    await single.socket.send(frame_of("say", STRING, b"continues"))
    assert await end.received.get() == b"continues"


async def test_robot_that_did_not_ask_is_refused_one_frame(cloud: Cloud, robot: Robot) -> None:
    await cloud.joined("say", "SubscriberForwarder", STRING)
    await robot.socket.send(frame_of("say", STRING, b"x"))
    assert await robot.get("ER") == "a binary frame must start with 32 hexadecimal characters"


async def test_message_that_is_too_long_for_one_frame_takes_two(cloud: Cloud, single: Robot) -> None:
    end = await cloud.joined("hear", "PublisherForwarder", STRING)
    await single.get("ST")
    end.port.send(bytes(MAX_PAYLOAD + 1))
    message = await single.get("DM")
    frame = await single.binary()
    assert frame[:32].decode() == message["msg*"]
    assert len(frame) == 32 + MAX_PAYLOAD + 1
