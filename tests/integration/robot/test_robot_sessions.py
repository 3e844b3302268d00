"""A robot's connection from handshake to end, and what the master hears of it."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from support.client_types import ros_string
from support.cloud import DIGEST, running_cloud
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.typing import Origin

from rce.control.messages import ClientRequest, Probe
from rce.control.model import EndpointState
from rce_robot.doors.client.outbox import OutboxLimits
from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from integration.robot.conftest import Dial, Robot
    from support.cloud import Cloud


STRING = "std_msgs/String"
ROBOT = "testUser/testRobot"


async def refused(attempt: connect) -> tuple[int, str]:
    with pytest.raises(InvalidStatus) as caught:
        async with attempt:
            pass
    body = caught.value.response.body
    return caught.value.response.status_code, bytes(body or b"").decode()


async def test_a_robot_that_breaks_the_protocol_is_cut_off() -> None:
    """It goes on sending, and does not end its side of the connection."""
    begin = Frame(Opcode.TEXT, b"a", fin=False).serialize(mask=True)
    ping = Frame(Opcode.PING, b"").serialize(mask=True)
    async with running_cloud(SessionSettings(ping_interval=None, close_timeout=0.2)) as cloud:
        port = int(cloud.ws_url.rpartition(":")[2].rstrip("/"))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(
            f"GET /?userID=testUser&robotID=r&password={DIGEST} HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
        writer.write(begin + begin)
        try:
            async with asyncio.timeout(60):
                await write_until_lost(writer, ping)
        finally:
            writer.transport.abort()


async def write_until_lost(writer: asyncio.StreamWriter, data: bytes) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            writer.write(data)
            await writer.drain()
            await asyncio.sleep(0.05)


# The handshake


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("", "userID"),
        (f"userID=testUser&password={DIGEST}", "robotID"),
        (f"userID=testUser&userID=x&robotID=r&password={DIGEST}", "userID"),
        (f"userID=testUser&robotID=1r&password={DIGEST}", "robotID"),
    ],
)
async def test_bad_query(cloud: Cloud, query: str, word: str, connect_to: Callable[[str], connect]) -> None:
    status, reason = await refused(connect_to(f"{cloud.ws_url}?{query}"))
    assert status == 400
    assert word in reason


async def test_wrong_password(cloud: Cloud, dial: Dial) -> None:
    status, reason = await refused(dial(cloud, password="0" * 64))
    assert status == 401
    assert "Wrong" in reason
    assert cloud.master.inside == set()


async def test_second_connection_of_a_robot(cloud: Cloud, dial: Dial) -> None:
    async with dial(cloud):
        status, reason = await refused(dial(cloud))
        assert status == 409
        assert "connected" in reason
        async with dial(cloud, robot="other"):
            pass
    await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)
    async with dial(cloud):
        pass


async def test_pages_of_other_sites_are_refused(dial: Dial) -> None:
    async with running_cloud(origins=("https://fleet.example",)) as cloud:
        status, reason = await refused(dial(cloud, origin=Origin("https://evil.example")))
        assert status == 403
        assert "evil" in reason
        async with dial(cloud, origin=Origin("https://fleet.example")):
            pass


async def test_programs_that_name_the_endpoint_as_origin(cloud: Cloud, dial: Dial) -> None:
    """Some WebSocket libraries (websocket-client, ws4py) send the endpoint's own address as ``Origin``."""
    own = cloud.ws_url.replace("ws:", "http:").rstrip("/")
    async with dial(cloud, origin=Origin(own)):
        pass
    for other in ("http://127.0.0.1:1", "http://localhost:1", "null"):
        status, _ = await refused(dial(cloud, origin=Origin(other)))
        assert status == 403


async def test_no_login_while_the_master_is_away(dial: Dial) -> None:
    async with running_cloud(login_timeout=0.05) as cloud:
        cloud.master.silent = True
        status, reason = await refused(dial(cloud))
        assert status == 503
        assert "master" in reason


async def test_a_dead_connection_makes_room_for_the_robots_new_one(dial: Dial) -> None:
    settings = SessionSettings(probe_timeout=0.2, drain_timeout=1.0)
    async with running_cloud(settings) as cloud, dial(cloud) as dead:
        dead.transport.pause_reading()  # like a Wi-Fi that is gone: no pong will come
        async with dial(cloud) as alive:
            await cloud.master.changed.until(lambda: ROBOT in cloud.master.inside)
            await (await alive.ping())
        dead.transport.resume_reading()
        with pytest.raises(ConnectionClosed):
            await dead.recv()


async def test_robot_that_sends_but_does_not_read_keeps_its_place(dial: Dial, robot_of: type[Robot]) -> None:
    """A robot whose program reads late is not displaced while it sends."""
    settings = SessionSettings(probe_timeout=0.5, drain_timeout=1.0)
    async with running_cloud(settings) as cloud, dial(cloud) as busy:
        busy.transport.pause_reading()
        robot = robot_of(busy)

        async def send() -> None:
            while True:
                await robot.say("unknown", STRING, {"data": "x"})
                await asyncio.sleep(0.02)  # the rate of a sensor

        sending = asyncio.create_task(send())
        try:
            status, _ = await refused(dial(cloud))
        finally:
            sending.cancel()
        assert status == 409
        busy.transport.resume_reading()
        await (await busy.ping())


async def test_robot_that_returns_waits_for_its_last_requests(dial: Dial, robot_of: type[Robot]) -> None:
    """A robot that disconnects during a request and connects again is admitted."""
    async with running_cloud(SessionSettings(probe_timeout=0.05, drain_timeout=30.0)) as cloud:
        asked, released = asyncio.Event(), asyncio.Event()

        async def wait(_: object) -> tuple[str, ...]:
            asked.set()
            await released.wait()
            return ()

        cloud.master.answer = wait
        async with dial(cloud) as socket:
            await robot_of(socket).send("CC", {"containerTag": "c"})
            await asked.wait()
        asyncio.get_running_loop().call_later(0.3, released.set)  # some times as long as a probe takes
        async with dial(cloud) as again:
            await (await again.ping())
        assert cloud.master.refused_logins


async def test_dead_connection_ends_when_robot_moves(dial: Dial) -> None:
    """A dead connection is ended when its robot comes elsewhere."""
    settings = SessionSettings(probe_timeout=0.2, drain_timeout=1.0)
    async with running_cloud(settings) as cloud, dial(cloud) as alive, dial(cloud, robot="other") as dead:
        dead.transport.pause_reading()
        assert cloud.master.peer is not None
        for tag in ("testRobot", "other", "nobody"):
            cloud.master.peer.send(Probe(id=f"testUser/{tag}"))
        await cloud.master.changed.until(lambda: cloud.master.left)
        assert cloud.master.left == ["testUser/other"]
        await (await alive.ping())
        dead.transport.resume_reading()
        with pytest.raises(ConnectionClosed):
            await dead.recv()


# What the master hears


async def test_the_master_hears_of_coming_and_going(cloud: Cloud, dial: Dial) -> None:
    assert cloud.master.url == cloud.ws_url
    async with dial(cloud):
        await cloud.master.changed.until(lambda: cloud.master.running(ROBOT))
        end = await cloud.joined("say", "SubscriberConverter", STRING)
        await cloud.master.changed.until(lambda: cloud.master.statuses[ROBOT].interfaces == {"say": True})
        assert cloud.master.statuses[ROBOT].connections == (1,)
        assert cloud.master.statuses[ROBOT].revision == cloud.master.specs[ROBOT].revision
    await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)
    assert cloud.master.statuses[ROBOT].state is EndpointState.ABSENT
    assert end.is_active  # a robot that is away keeps its connections


async def test_usage_is_reported(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    await robot.say("say", STRING, {"data": "x"})
    await end.received.get()

    def counted() -> bool:
        usage = cloud.master.usage
        found = usage.endpoints[ROBOT].interfaces.get("say") if usage and ROBOT in usage.endpoints else None
        return found is not None and found.messages_out == 1 and found.bytes_out >= 5

    await cloud.master.changed.until(counted)
    assert cloud.master.usage is not None
    assert cloud.master.usage.memory > 0


@pytest.mark.parametrize("current", [False, True])
async def test_requests_reach_masters_of_both_releases(
    dial: Dial, robot_of: type[Robot], current: bool
) -> None:
    """A master of the release before gets what the client wrote, a current one what was read of it."""
    async with running_cloud(in_patches=current) as cloud, dial(cloud) as socket:
        robot = robot_of(socket)
        await robot.send("CC", {"containerTag": "c1", "containerData": {"memory": "5M", "cpu": "50%"}})
        await cloud.master.changed.until(lambda: len(cloud.master.requests) == 1)
        sent = {"containerTag": "c1", "containerData": {"memory": 5, "cpu": 0.5}}
        assert cloud.master.requests == [(ROBOT, "CC", sent)]


async def test_requests_go_to_the_master_in_order_and_errors_come_back(cloud: Cloud, robot: Robot) -> None:
    async def refuse(request: ClientRequest) -> tuple[str, ...]:
        return ("no room", "no luck") if request.type == "CC" else ()

    cloud.master.answer = refuse
    await robot.send("CC", {"containerTag": "c1", "containerData": {"memory": 5}})
    await robot.send("DC", {"containerTag": "c1"})
    await robot.send(
        "CN", {"removeNodes": [{"containerTag": "c1", "nodeTag": "n"}, {"containerTag": "bad tag"}]}
    )
    errors = [await robot.get("ER") for _ in range(3)]
    assert sorted(errors)[-2:] == ["no luck", "no room"]
    assert any("removeNodes[1].containerTag" in error for error in errors)
    await cloud.master.changed.until(lambda: len(cloud.master.requests) == 3)
    assert [type_ for _, type_, _ in cloud.master.requests] == ["CC", "DC", "CN"]
    assert cloud.master.requests[0] == (ROBOT, "CC", {"containerTag": "c1", "containerData": {"memory": 5}})
    assert cloud.master.requests[2][2] == {"removeNodes": [{"containerTag": "c1", "nodeTag": "n"}]}


async def test_a_parameter_that_is_no_number_leaves_the_master_alone(
    dial: Dial, robot_of: type[Robot]
) -> None:
    """One robot's NaN must not end the connection that the requests of all robots take."""
    async with running_cloud(in_patches=True) as cloud, dial(cloud) as socket:
        robot, peer = robot_of(socket), cloud.master.peer
        item = {"containerTag": "c", "name": "p", "value": float("nan")}
        await robot.send("CN", {"setParam": [item]})
        assert "data.setParam[0].value: must be a finite number" in await robot.get("ER")
        await robot.send("DC", {"containerTag": "c"})
        await cloud.master.changed.until(lambda: any(kind == "DC" for _, kind, _ in cloud.master.requests))
        assert cloud.master.peer is peer


async def test_a_leaving_robots_last_requests_are_carried_out(cloud: Cloud, robot: Robot) -> None:
    for number in range(20):
        await robot.send("DC", {"containerTag": f"c{number}"})
    await robot.socket.close()
    await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)
    assert len(cloud.master.requests) == 20


async def test_everything_goes_on_while_the_master_is_away(cloud: Cloud, robot: Robot) -> None:
    end = await cloud.joined("say", "SubscriberConverter", STRING)
    assert cloud.master.peer is not None
    cloud.master.peer.abort()
    await robot.say("say", STRING, {"data": "x"})
    assert await end.received.get() == ros_string("x")
    await cloud.master.changed.until(lambda: cloud.master.peer is None)
    await cloud.master.changed.until(lambda: cloud.master.peer is not None)
    assert cloud.master.running(ROBOT)
    await robot.say("say", STRING, {"data": "y"})
    assert await end.received.get() == ros_string("y")


# Coming back


async def test_a_robot_that_comes_back_finds_its_interfaces(
    cloud: Cloud, dial: Dial, robot_of: type[Robot]
) -> None:
    async with dial(cloud):
        say = await cloud.joined("say", "SubscriberConverter", STRING)
        hear = await cloud.joined("hear", "PublisherConverter", STRING)
    await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)
    hear.port.send(ros_string("lost"))
    hear.port.send(ros_string("map"), latched=True)
    async with dial(cloud) as socket:
        robot = robot_of(socket)
        active = [await robot.get("ST"), await robot.get("ST")]
        assert sorted((status["iTag"], status["status"]) for status in active) == [
            ("hear", True),
            ("say", True),
        ]
        assert (await robot.get("DM"))["msg"] == {"data": "map"}
        await robot.say("say", STRING, {"data": "back"})
        assert await say.received.get() == ros_string("back")


async def test_status_follows_the_connection(cloud: Cloud, robot: Robot) -> None:
    await cloud.joined("say", "SubscriberConverter", STRING)
    assert (await robot.get("ST"))["status"] is True
    cloud.master.put(ROBOT, connections=())
    assert await robot.get("ST") == {"topic": "iu", "iTag": "say", "status": False}


async def test_a_dropped_robot_is_told_why_and_is_gone(cloud: Cloud, robot: Robot) -> None:
    await cloud.joined("say", "SubscriberConverter", STRING)
    await robot.get("ST")
    cloud.master.drop(ROBOT, "user was removed")
    with pytest.raises(ConnectionClosed) as caught:
        await robot.get("nothing")
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.reason == "user was removed"
    await cloud.master.changed.until(lambda: ROBOT in cloud.master.gone)


@pytest.mark.parametrize("elsewhere", [False, True])
async def test_requests_of_a_robot_that_is_sent_elsewhere(
    dial: Dial, robot_of: type[Robot], elsewhere: bool
) -> None:
    """They are carried out: its client takes them for done. Those of a robot that is removed are not."""
    async with running_cloud(SessionSettings(drain_timeout=60.0)) as cloud, dial(cloud) as socket:
        asked, released = asyncio.Event(), asyncio.Event()

        async def wait(_: object) -> tuple[str, ...]:
            asked.set()
            await released.wait()
            return ()

        cloud.master.answer = wait
        robot = robot_of(socket)
        for number in range(3):
            await robot.send("DC", {"containerTag": f"c{number}"})
        await (await socket.ping())
        await asked.wait()
        cloud.master.drop(ROBOT, "connect again", elsewhere=elsewhere)
        with pytest.raises(ConnectionClosed):
            await robot.get("nothing")
        if elsewhere:
            released.set()  # the connection ended before
        await cloud.master.changed.until(lambda: ROBOT in cloud.master.gone)
        told = [data["containerTag"] for _, _, data in cloud.master.requests]
        assert told == (["c0", "c1", "c2"] if elsewhere else ["c0"])
        released.set()


# Abuse


async def test_too_large_a_message_ends_the_connection(dial: Dial) -> None:
    async with (
        running_cloud(SessionSettings(max_message=1000, drain_timeout=1.0)) as cloud,
        dial(cloud) as socket,
    ):
        await socket.send("x" * 1001)
        with pytest.raises(ConnectionClosed) as caught:
            await socket.recv()
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1009


async def test_text_that_is_not_utf8_ends_the_connection(cloud: Cloud, robot: Robot) -> None:
    await robot.socket.send(b'{"type": "\xff"}', text=True)
    with pytest.raises(ConnectionClosed) as caught:
        await robot.socket.recv()
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1007


async def test_requests_that_wait_are_bounded_by_their_bytes(dial: Dial, robot_of: type[Robot]) -> None:
    settings = SessionSettings(max_request_bytes=3000, drain_timeout=1.0)
    async with running_cloud(settings) as cloud, dial(cloud) as socket:
        released = asyncio.Event()

        async def wait(_: object) -> tuple[str, ...]:
            await released.wait()
            return ()

        cloud.master.answer = wait
        robot = robot_of(socket)
        for tag in ("first", "second", "third"):
            parts = [{"containerTag": tag, "name": "p", "value": "x" * 1000}]
            await robot.send("CN", {"setParam": parts})
        assert "too many requests wait" in await robot.get("ER")
        released.set()
        await cloud.master.changed.until(lambda: len(cloud.master.requests) == 2)
        await robot.send("CC", {"containerTag": "c"})
        await cloud.master.changed.until(lambda: len(cloud.master.requests) == 3)
        assert [kind for _, kind, _ in cloud.master.requests] == ["CN", "CN", "CC"]


async def test_a_robot_that_stops_reading_harms_itself_only(dial: Dial, robot_of: type[Robot]) -> None:
    settings = SessionSettings(
        outbox=OutboxLimits(queue_bytes=2 << 20, total_bytes=4 << 20), ping_interval=None, drain_timeout=1.0
    )
    async with (
        running_cloud(settings) as cloud,
        dial(cloud, robot="stalled") as stalled,
        dial(cloud, robot="healthy") as socket,
    ):
        slow = await cloud.joined("image", "PublisherForwarder", STRING, robot="stalled")
        fast = await cloud.joined("image", "PublisherForwarder", STRING, robot="healthy")
        healthy = robot_of(socket)
        await healthy.get("ST")
        stalled.transport.pause_reading()
        payload = bytes(1 << 20)
        for number in range(40):
            slow.port.send(payload)
            fast.port.send(struct.pack("<I", number))
            await healthy.get("DM")
            assert (await healthy.binary())[32:] == struct.pack("<I", number)

        def dropped() -> bool:
            usage = cloud.master.usage
            endpoint = usage.endpoints.get("testUser/stalled") if usage else None
            found = endpoint.interfaces.get("image") if endpoint else None
            return found is not None and found.dropped > 10

        await cloud.master.changed.until(dropped)
        stalled.transport.resume_reading()
        await robot_of(stalled).get("DM")
