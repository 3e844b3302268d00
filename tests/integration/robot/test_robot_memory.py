"""Users that flood the engine lose their own, in the end their connection; others notice nothing."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Unpack

import psutil
import pytest
from support.client_types import ros_string
from support.cloud import DIGEST, Cloud, RobotOptions, running_cloud
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from rce.link import OverloadedError
from rce_robot.conversion.pool import ConversionSettings
from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.robot.conftest import Robot

MIB = 1 << 20
STRING = "std_msgs/String"
PATIENT = SessionSettings(ping_interval=None, drain_timeout=1.0)


def dial(cloud: Cloud, user: str, robot: str) -> connect:
    query = f"userID={user}&robotID={robot}&password={DIGEST}"
    return connect(f"{cloud.ws_url}?{query}", proxy=None, compression=None, max_size=None)


@asynccontextmanager
async def small_cloud(
    **settings: Unpack[RobotOptions],
) -> AsyncIterator[tuple[Cloud, ClientConnection, AsyncExitStack]]:
    """A cloud with little memory, and the robot of a user who does nothing wrong."""
    async with running_cloud(PATIENT, **settings) as cloud, AsyncExitStack() as stack:
        cloud.master.users.add("flood")
        good = await stack.enter_async_context(dial(cloud, "testUser", "good"))
        yield cloud, good, stack


async def still_served(good: ClientConnection) -> None:
    async with asyncio.timeout(60):
        await (await good.ping())
    assert good.close_code is None


async def close_of(socket: ClientConnection) -> tuple[int, str]:
    """Read on until a connection ends; return how."""
    with pytest.raises(ConnectionClosed) as ended:  # noqa: PT012 - whatever comes before
        async with asyncio.timeout(60):
            while True:
                await socket.recv()
    assert ended.value.rcvd is not None
    return ended.value.rcvd.code, ended.value.rcvd.reason


async def test_unclaimed_values_are_dropped_oldest_first(robot_of: type[Robot]) -> None:
    async with small_cloud(user_memory=4 * MIB) as (cloud, good, stack):
        sockets = [await stack.enter_async_context(dial(cloud, "flood", f"f{n}")) for n in range(3)]
        for number in range(4):
            for socket in sockets:
                await socket.send(b"%032x" % number + bytes(MIB))
        texts = [await robot_of(socket).get("ER") for socket in sockets[:2]]
        assert all("memory is short" in text for text in texts)
        await still_served(good)
        await cloud.master.changed.until(lambda: cloud.master.usage and cloud.master.usage.shed)
        assert cloud.master.usage is not None
        assert cloud.master.usage.held <= 5 * MIB


async def test_endless_messages_end_the_connection(robot_of: type[Robot]) -> None:
    async with small_cloud(user_memory=4 * MIB) as (cloud, good, stack):
        sockets = [await stack.enter_async_context(dial(cloud, "flood", f"f{n}")) for n in range(2)]

        async def chunks() -> AsyncIterator[bytes]:
            while True:
                yield bytes(MIB // 2)

        async def flood(socket: ClientConnection) -> tuple[int, str]:
            sending = asyncio.create_task(socket.send(chunks()))
            try:
                return await close_of(socket)
            finally:
                sending.cancel()
                await asyncio.wait([sending])

        code, reason = await flood(sockets[0])
        assert (code, reason) == (
            1013,
            "the robots of user flood hold more memory of the engine than they may",
        )
        await still_served(good)
        await still_served(sockets[1])
        await cloud.master.changed.until(lambda: "flood/f0" in cloud.master.left)
        again = await stack.enter_async_context(dial(cloud, "flood", "f0"))
        await still_served(again)


async def test_robots_that_do_not_read_lose_their_own_messages(robot_of: type[Robot]) -> None:
    async with small_cloud(user_memory=6 * MIB) as (cloud, good, stack):
        stalled = [await stack.enter_async_context(dial(cloud, "testUser", f"s{n}")) for n in range(3)]
        ends = [await cloud.joined("image", "PublisherForwarder", STRING, robot=f"s{n}") for n in range(3)]
        for socket in stalled:
            socket.transport.pause_reading()
        for _ in range(16):
            for end in ends:
                end.port.send(bytes(MIB))
            await still_served(good)

        def dropped() -> int:
            usage = cloud.master.usage
            found = usage.endpoints if usage else {}
            return sum(e.interfaces["image"].dropped for e in found.values() if "image" in e.interfaces)

        await cloud.master.changed.until(lambda: dropped() >= 20)
        assert cloud.master.usage is not None
        assert cloud.master.usage.held <= 6 * MIB
        for socket in stalled:
            socket.transport.resume_reading()
            assert await robot_of(socket).get("DM")


async def test_all_users_together_have_a_bound_too(robot_of: type[Robot]) -> None:
    async with small_cloud(memory=4 * MIB) as (cloud, good, stack):
        flood = await stack.enter_async_context(dial(cloud, "flood", "f"))
        await good.send(b"%032x" % 1 + bytes(MIB))
        for number in range(8):
            await flood.send(b"%032x" % number + bytes(MIB))
        assert "memory is short" in (await robot_of(flood).get("ER"))
        await still_served(good)
        data = {"iTag": "none", "type": STRING, "msgID": "m", "msg*": f"{1:032x}"}
        await good.send(json.dumps({"type": "DM", "data": data}))
        assert "none" in (await robot_of(good).get("ER")), "what the other user sent first is still there"


async def test_latched_over_limit_are_dropped_oldest_first() -> None:
    """The robot is away; 60 latched topics bring 60 MB, of which its user may hold 20."""
    async with running_cloud(PATIENT, user_memory=20 * MIB) as cloud:
        ends = [await cloud.wire(f"map{number}", "PublisherForwarder", STRING) for number in range(60)]
        async with dial(cloud, "testUser", "testRobot"):
            for end in ends:
                await end.until_active()

        def have_arrived(count: int) -> bool:
            usage = cloud.master.usage
            endpoint = usage.endpoints.get("testUser/testRobot") if usage else None
            found = endpoint.interfaces if endpoint else {}
            return sum(interface.messages_in for interface in found.values()) >= count

        for count in range(10, 61, 10):
            for end in ends[count - 10 : count]:
                end.port.send(bytes(MIB), latched=True)
            await cloud.master.changed.until(partial(have_arrived, count))
            assert cloud.master.usage is not None
            assert cloud.master.usage.held <= 20 * MIB
        assert cloud.master.usage is not None
        assert cloud.master.usage.held > 15 * MIB


async def test_a_burst_of_latched_messages_reaches_a_robot_that_reads() -> None:
    """More than the queues of a robot hold comes at once, when it comes back."""
    count, size = 12, 8 * MIB
    async with running_cloud(PATIENT) as cloud:
        ends = [await cloud.wire(f"map{number}", "PublisherForwarder", STRING) for number in range(count)]
        async with dial(cloud, "testUser", "testRobot"):
            for end in ends:
                await end.until_active()
        for end in ends:
            end.port.send(bytes(size), latched=True)
        await cloud.master.changed.until(
            lambda: cloud.master.usage is not None and cloud.master.usage.held >= count * size
        )
        query = f"userID=testUser&robotID=testRobot&password={DIGEST}"
        async with connect(f"{cloud.ws_url}?{query}", proxy=None, compression=None, max_size=None) as robot:
            tags: set[str] = set()
            binaries = 0
            async with asyncio.timeout(60):
                while len(tags) < count or binaries < count:
                    frame = await robot.recv()
                    if isinstance(frame, bytes):
                        binaries += 1
                        assert len(frame) == size + 32
                    elif (message := json.loads(frame))["type"] == "DM":
                        tags.add(message["data"]["iTag"])
            assert tags == {f"map{number}" for number in range(count)}


async def test_a_latched_burst_over_the_limit_does_not_end_the_link() -> None:
    """60 MB of 20 topics begin to come in at once, of which the user may hold 16; the rest is dropped."""
    count, size, limit = 20, 3 * MIB, 16 * MIB
    async with running_cloud(PATIENT, user_memory=limit) as cloud:
        ends = [await cloud.wire(f"map{number}", "PublisherForwarder", STRING) for number in range(count)]
        after = await cloud.wire("after", "PublisherForwarder", STRING)
        async with dial(cloud, "testUser", "testRobot") as robot:
            for end in (*ends, after):
                await end.until_active()
            for end in ends:
                end.port.send(bytes(size), latched=True)

            def moved() -> bool:
                usage = cloud.master.usage
                if usage is None or usage.held > limit or "testUser/testRobot" not in usage.endpoints:
                    return False
                interfaces = usage.endpoints["testUser/testRobot"].interfaces
                came = sum(interface.messages_in for interface in interfaces.values())
                dropped = sum(interface.dropped for interface in interfaces.values())
                return came > 0 and dropped > 0 and came + dropped >= count

            await cloud.master.changed.until(moved)
            assert any("memory is short" in fault for fault in cloud.master.faults)
            after.port.send(b"\1\0\0\0x")
            async with asyncio.timeout(60):
                while True:
                    frame = await robot.recv()
                    if isinstance(frame, str) and '"iTag":"after"' in frame and '"DM"' in frame:
                        break
        assert [end.losses for end in (*ends, after)] == [0] * (count + 1)


async def test_a_call_dropped_while_it_comes_in_ends_at_its_caller() -> None:
    """A request of 30 MB comes to a robot whose user may hold 16 MB."""
    async with running_cloud(PATIENT, user_memory=16 * MIB) as cloud:
        end = await cloud.wire("serve", "ServiceClientForwarder", "std_srvs/SetBool")
        async with dial(cloud, "testUser", "testRobot"):
            await end.until_active()
            with pytest.raises(OverloadedError, match="the request was dropped: memory is short"):
                await end.port.call(bytes(30 * MIB))
            assert end.losses == 0


async def test_answers_that_wait_for_conversion_count(robot_of: type[Robot]) -> None:
    """The process that converts them hangs; over the user's limit the oldest calls are given up."""
    service, text = "std_srvs/SetBool", "ö" * MIB
    size = 2 * MIB
    conversion = ConversionSettings(workers=1, timeout=600.0)
    before = set(psutil.Process().children())
    async with running_cloud(PATIENT, user_memory=8 * MIB, conversion=conversion) as cloud:
        end = await cloud.wire("ask", "ServiceProviderConverter", service)

        async def answer(_: bytes) -> bytes:
            return b"\x01" + ros_string(text)

        end.answer = answer
        async with dial(cloud, "testUser", "testRobot") as socket:
            await end.until_active()
            robot = robot_of(socket)
            await robot.say("ask", service, {"data": True}, "first")
            assert (await robot.get("DM"))["msgID"] == "first"
            (converter,) = set(psutil.Process().children()) - before
            converter.suspend()

            for number in range(3):
                await robot.say("ask", service, {"data": True}, f"id{number}")
            await cloud.master.changed.until(
                lambda: cloud.master.usage is not None and cloud.master.usage.held >= 3 * size
            )
            for number in range(3, 6):
                await robot.say("ask", service, {"data": True}, f"id{number}")
            report = await robot.get("ER")
            assert "memory is short; the call was given up" in str(report)
            converter.resume()
            assert (await robot.get("DM"))["msgID"] in {f"id{number}" for number in range(6)}
