"""ROS time: simulated and real, with rates, timers and sleeping."""

from __future__ import annotations

import asyncio

from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.node import Node, Publisher, TimerEvent
from rce.ros.node.clock import CLOCK
from rce.ros.types import Time, TypeRegistry


def test_the_clock_has_the_checksum_of_its_type() -> None:
    assert TypeRegistry().message(CLOCK.name).md5sum == CLOCK.md5sum


async def tick(publisher: Publisher, node: Node, seconds: float) -> None:
    """Set the time, and wait until a node knows."""
    publisher.publish(clock=Time.from_sec(seconds))
    async with asyncio.timeout(60):
        while node.time() != seconds:
            await asyncio.sleep(0)


async def test_time_is_simulated(core: Core, make_node: MakeNode) -> None:
    core.set_param("/use_sim_time", True)
    async with make_node("sim") as sim, make_node("a") as a:
        publisher = await sim.advertise("/clock", "rosgraph_msgs/Clock")
        await publisher.wait_for_subscribers(2, timeout=10)
        assert a.is_time_simulated
        assert a.now() == Time(0, 0)
        await tick(publisher, a, 10.5)
        assert a.now() == Time(10, 500_000_000)

        sleeper = asyncio.create_task(a.sleep(100.0))
        beats: list[float] = []
        calls: list[TimerEvent] = []

        async def beat() -> None:
            async for _ in a.rate(1.0):
                beats.append(a.time())  # noqa: PERF401 - one by one, as they come

        beating = asyncio.create_task(beat())
        a.timer(2.0, calls.append)
        once = a.timer(1.0, lambda event: None, oneshot=True)
        await asyncio.sleep(0)
        for second in range(11, 16):
            await tick(publisher, a, float(second) + 0.5)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert beats == [10.5, 11.5, 12.5, 13.5, 14.5, 15.5]
        assert [(call.now, call.expected, call.last) for call in calls] == [
            (12.5, 12.5, None),
            (14.5, 14.5, 12.5),
        ]
        assert once.calls == 1
        assert not sleeper.done()
        await tick(publisher, a, 111.0)
        assert await sleeper

        long = asyncio.create_task(a.sleep(1000.0))
        await asyncio.sleep(0)
        await tick(publisher, a, 5.0)
        assert await long, "time that jumps back wakes sleepers"
        await tick(publisher, a, 6.0)
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)

        asleep = asyncio.create_task(a.sleep(1000.0))
        await asyncio.sleep(0)
        a.shutdown()
        assert not await asleep
        assert not await a.sleep(0)


async def test_timers_and_rates_when_time_jumps_back(core: Core, make_node: MakeNode) -> None:
    core.set_param("/use_sim_time", True)
    async with make_node("sim") as sim, make_node("a") as a:
        publisher = await sim.advertise("/clock", "rosgraph_msgs/Clock")
        await publisher.wait_for_subscribers(2, timeout=10)
        await tick(publisher, a, 100.0)
        calls: list[tuple[float, float, float | None]] = []
        a.timer(2.0, lambda event: calls.append((event.expected, event.now, event.last)))
        once = a.timer(3.0, lambda event: None, oneshot=True)
        beats: list[float] = []

        async def beat() -> None:
            async for _ in a.rate(0.5):
                beats.append(a.time())  # noqa: PERF401 - one by one, as they come

        beating = asyncio.create_task(beat())
        await asyncio.sleep(0)
        for seconds in (101.0, 102.0, 50.0, 51.0, 52.0, 54.0, 200.0, 201.0, 202.0):
            await tick(publisher, a, seconds)
            for _ in range(4):
                await asyncio.sleep(0)
        assert [(due, now) for due, now, _ in calls] == [
            (102.0, 102.0),
            (52.0, 52.0),  # a period after the jump, not at it
            (54.0, 54.0),
            (56.0, 200.0),  # what was missed meanwhile is left out
            (202.0, 202.0),
        ]
        assert beats == [100.0, 102.0, 50.0, 52.0, 54.0, 200.0, 202.0]
        assert once.calls == 1
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)


async def test_log_records_carry_simulated_time(core: Core, make_node: MakeNode) -> None:
    core.set_param("/use_sim_time", True)
    async with make_node("sim") as sim, make_node("a") as a:
        publisher = await sim.advertise("/clock", "rosgraph_msgs/Clock")
        await publisher.wait_for_subscribers(2, timeout=10)
        await tick(publisher, a, 7.25)
        heard = await sim.subscribe("/rosout", "rosgraph_msgs/Log")
        a.log.info("hello")
        async with asyncio.timeout(60):
            async for record in heard:
                if record.name == "/a":
                    assert record.header.stamp == Time(7, 250_000_000)
                    break


async def test_real_time(make_node: MakeNode) -> None:
    async with make_node("a") as a:
        assert not a.is_time_simulated
        assert abs(a.time() - Time.now().to_sec()) < 10
        called = asyncio.Event()

        async def fail_first(event: TimerEvent) -> None:
            if event.last is None:
                raise RuntimeError("as planned")
            called.set()

        timer = a.timer(0.01, fail_first)
        await asyncio.wait_for(called.wait(), 10)
        timer.stop()
        before = a.time()
        rate = a.rate(200.0)
        for _ in range(3):
            assert await rate.sleep()
        assert a.time() - before >= 0.014
        asleep = asyncio.create_task(a.sleep(1000.0))
        await asyncio.sleep(0)
        a.shutdown()
        assert not await asyncio.wait_for(asleep, 10)
        assert not await rate.sleep()


async def test_what_begins_at_time_zero_counts_from_the_first_tick(core: Core, make_node: MakeNode) -> None:
    """As in roscpp and rospy: time zero means that the simulation has not begun."""
    core.set_param("/use_sim_time", True)
    async with make_node("sim") as sim, make_node("a") as a:
        publisher = await sim.advertise("/clock", "rosgraph_msgs/Clock")
        await publisher.wait_for_subscribers(2, timeout=10)
        calls: list[TimerEvent] = []
        a.timer(2.0, calls.append)
        once = a.timer(5.0, lambda event: None, oneshot=True)
        sleeper = asyncio.create_task(a.sleep(3.0))
        beats: list[float] = []

        async def beat() -> None:
            async for _ in a.rate(1.0):
                beats.append(a.time())  # noqa: PERF401 - one by one, as they come

        beating = asyncio.create_task(beat())
        await asyncio.sleep(0)
        for second in range(1000, 1005):
            await tick(publisher, a, float(second))
            for _ in range(4):
                await asyncio.sleep(0)
            assert sleeper.done() == (second >= 1003)
        assert beats == [0.0, 1001.0, 1002.0, 1003.0, 1004.0]
        assert [(call.now, call.expected) for call in calls] == [(1002.0, 1002.0), (1004.0, 1004.0)]
        assert not once.calls
        assert await sleeper
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)
