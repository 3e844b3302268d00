"""Messages between a robot's WebSocket and its peers, for all four roles and both forms."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from support.client_types import ros_string

from rce.control import Notify
from rce.link import PeerFaultError
from rce_robot.doors.client.session import MAX_PROBLEM

if TYPE_CHECKING:
    from integration.robot.conftest import Robot
    from support.cloud import Cloud

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"


async def test_robot_to_container_as_json(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    assert await robot.get("ST") == {"topic": "iu", "iTag": "say", "status": True}
    await robot.say("say", STRING, {"data": "hello"})
    assert await end.received.get() == ros_string("hello")


async def test_robot_to_container_serialized(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberForwarder", STRING)
    id_ = "0123456789abcdef" * 2
    await robot.socket.send(id_.encode() + b"any bytes at all")
    await robot.say("say", STRING, id_, key="msg*")
    assert await end.received.get() == b"any bytes at all"


async def test_container_to_robot_as_json(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("hear", "PublisherConverter", STRING)
    end.port.send(ros_string("hello"))
    expected = {"iTag": "hear", "type": STRING, "msgID": "nil", "msg": {"data": "hello"}}
    assert await robot.get("DM") == expected


async def test_container_to_robot_serialized_at_all_frame_sizes(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("hear", "PublisherForwarder", STRING)
    await robot.get("ST")
    for size in (0, 1, 93, 94, 125, 126, 65_000, 65_503, 65_504, 1_000_000):
        payload = bytes(size)
        end.port.send(payload)
        message = await robot.get("DM")
        assert message["msgID"] == "nil"
        frame = await robot.binary()
        assert frame[:32].decode() == message["msg*"]
        assert frame[32:] == payload


async def test_robot_calls_a_service(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("ask", "ServiceProviderConverter", ECHO)
    first = asyncio.Event()

    async def answer(payload: bytes) -> bytes:
        if payload == ros_string("slow"):
            await first.wait()
        return payload

    end.answer = answer
    await robot.say("ask", ECHO, {"data": "slow"}, 'id "1"')
    await robot.say("ask", ECHO, {"data": "quick"}, "id2")
    assert (await robot.get("DM"))["msgID"] == "id2"  # a slow call holds nobody up
    first.set()
    answered = await robot.get("DM")
    assert answered == {"iTag": "ask", "type": ECHO, "msgID": 'id "1"', "msg": {"data": "slow"}}


async def test_large_message_with_a_binary_value_keeps_its_place(cloud: Cloud, robot: Robot) -> None:
    picture = "sensor_msgs/CompressedImage"
    end = await cloud.joined("say", "SubscriberConverter", picture)
    id_ = "ab" * 16
    await robot.say("say", picture, {"format": "{" * 10_000, "data*": id_})  # too many braces to be light
    await robot.socket.send(id_.encode() + b"pixels")
    await robot.say("say", picture, {"format": "later"})
    first, second = await end.received.get(), await end.received.get()
    assert first.endswith(b"pixels")
    assert b"later" in second


async def test_a_failed_call_is_an_error_that_names_interface_and_id(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("ask", "ServiceProviderConverter", ECHO)

    async def fail(payload: bytes) -> bytes:
        raise ValueError("out of coffee")

    end.answer = fail
    await robot.say("ask", ECHO, {"data": "x"}, "id7")
    text = await robot.get("ER")
    assert text.startswith("ask, msgID id7: ")
    assert "out of coffee" in text


async def test_a_container_calls_the_robots_service(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("serve", "ServiceClientConverter", ECHO)
    calls = [asyncio.create_task(end.port.call(ros_string(text))) for text in ("one", "two")]
    requests = [await robot.get("DM"), await robot.get("DM")]
    assert len({request["msgID"] for request in requests}) == 2
    for request in reversed(requests):
        await robot.say("serve", ECHO, {"data": request["msg"]["data"].upper()}, request["msgID"])
    assert await asyncio.gather(*calls) == [ros_string("ONE"), ros_string("TWO")]


async def test_the_robots_failure_reaches_the_caller(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("serve", "ServiceClientConverter", ECHO)
    for answer, expected in (("no power", "no power"), ({"data": 5}, "data")):
        call = asyncio.create_task(end.port.call(ros_string("x")))
        request = await robot.get("DM")
        await robot.say("serve", ECHO, answer, request["msgID"])
        with pytest.raises(PeerFaultError, match=expected):
            await call


async def test_a_robot_that_leaves_fails_its_callers(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("serve", "ServiceClientConverter", ECHO)
    call = asyncio.create_task(end.port.call(ros_string("x")))
    await robot.get("DM")
    await robot.socket.close()
    for waiting in (call, asyncio.create_task(end.port.call(ros_string("y")))):
        with pytest.raises(PeerFaultError, match="robot"):
            await waiting


async def test_unknown_fields_are_told_once(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    for _ in range(3):
        await robot.say("say", STRING, {"data": "x", "nonsense": 1})
        assert await end.received.get() == ros_string("x")
    await robot.say("say", STRING, {"data": 7})
    assert "nonsense" in await robot.get("ER")
    assert "data" in await robot.get("ER")


async def test_long_error_text_is_cut(cloud: Cloud, robot: Robot) -> None:
    assert cloud.master.peer is not None
    cloud.master.peer.send(Notify(id="testUser/testRobot", text="x" * 100_000))
    assert await robot.get("ER") == "x" * MAX_PROBLEM


async def test_what_is_wrong_is_told_and_nothing_else_is_lost(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    await cloud.joined("hear", "PublisherConverter", STRING)
    wrong = {
        "no JSON at all": "JSON",
        '{"type": "XX", "data": {}}': "type",
        '{"type": "ER", "data": "x"}': "type",
        '{"type": "DM", "data": {"iTag": "nobody", "type": "std_msgs/String", "msg": {}}}': "nobody",
        '{"type": "DM", "data": {"iTag": "say", "type": "std_msgs/Int8", "msg": {}}}': "std_msgs/Int8",
        '{"type": "DM", "data": {"iTag": "hear", "type": "std_msgs/String", "msg": {}}}': "hear",
        '{"type": "DM", "data": {"iTag": "say", "type": "std_msgs/String", "msgID": "'
        + 256 * "x"
        + '", "msg": {}}}': "msgID",
    }
    for text, word in wrong.items():
        await robot.socket.send(text)
        assert word in await robot.get("ER")
    await robot.socket.send(b"too short")
    assert "binary" in await robot.get("ER")
    await robot.say("say", STRING, {"data": "still here"})
    assert await end.received.get() == ros_string("still here")


async def test_a_picture_travels_as_png_in_both_directions(cloud: Cloud, robot: Robot) -> None:
    up = await cloud.joined("up", "SubscriberConverter", "sensor_msgs/Image")
    down = await cloud.joined("down", "PublisherConverter", "sensor_msgs/Image")
    await robot.get("ST")
    await robot.get("ST")
    fields = {"height": 2, "width": 2, "encoding": "rgb8", "step": 6, "data": list(range(12))}
    await robot.say("up", "sensor_msgs/Image", fields)
    down.port.send(await up.received.get())
    message = await robot.get("DM")
    frame = await robot.binary()
    assert frame[32:40] == b"\x89PNG\r\n\x1a\n"
    await robot.socket.send(frame)
    await robot.say("up", "sensor_msgs/Image", message["msg*"], key="msg*")
    assert bytes(range(12)) in await up.received.get()


async def test_fragments_make_a_message(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    text = '{"type":"DM","data":{"iTag":"say","type":"std_msgs/String","msgID":"nil","msg":{"data":"parts"}}}'
    await robot.socket.send([text[:10], text[10:50], text[50:]])
    assert await end.received.get() == ros_string("parts")


@pytest.mark.parametrize("msg_id", [7, 7.0])
async def test_an_integer_msg_id_is_answered_as_text(cloud: Cloud, robot: Robot, msg_id: float) -> None:
    """Lua and MATLAB write 7.0 for 7."""
    await cloud.joined("ask", "ServiceProviderConverter", ECHO)
    data = {"iTag": "ask", "type": ECHO, "msgID": msg_id, "msg": {"data": "x"}}
    await robot.send("DM", data)
    assert (await robot.get("DM"))["msgID"] == "7"


@pytest.mark.parametrize(
    "data",
    [
        {"iTag": "ask", "type": ECHO, "msg": {"data": 5}},
        {"iTag": "ask", "type": "std_srvs/SetBool", "msg": {}},
        {"iTag": "ask", "type": "none", "msg": {}},
        {"iTag": "ask", "type": ECHO},
        {"iTag": "ask", "type": ECHO, "msg*": "no id"},
        {"iTag": "nobody", "type": ECHO, "msg": {}},
    ],
)
async def test_a_refused_request_ends_at_its_caller(cloud: Cloud, robot: Robot, data: dict[str, str]) -> None:
    await cloud.joined("ask", "ServiceProviderConverter", ECHO)
    await robot.send("DM", {**data, "msgID": "id7"})
    assert (await robot.get("ER")).startswith(f"{data['iTag']}, msgID id7: ")


@pytest.mark.parametrize(
    "answer", [{"type": "std_srvs/SetBool", "msg": {}}, {"type": "none", "msg": {}}, {"type": ECHO}]
)
async def test_a_refused_answer_fails_its_caller(cloud: Cloud, robot: Robot, answer: dict[str, str]) -> None:
    end = await cloud.joined("serve", "ServiceClientConverter", ECHO)
    call = asyncio.create_task(end.port.call(ros_string("x")))
    request = await robot.get("DM")
    await robot.send("DM", {"iTag": "serve", "msgID": request["msgID"], **answer})
    async with asyncio.timeout(10):  # far less than a call may take
        with pytest.raises(PeerFaultError, match="the robot's answer was refused: serve, msgID"):
            await call
