"""Processes that end or hang: kill -9, SIGTERM, SIGSTOP, and an upgrade."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from support.engine import until

from faults.machines import PATIENCE_S, Machine, fetch, send
from faults.scenarios.etcd import lead_etcd
from faults.world import World

LONG_ROUNDS = 25
"""Of each kind."""
STOP_S = 6.0
LONG_STOP_S = 30.0
LONG_ETCD_STOPS = 5
"""Of each kind."""
TERMINATED = "SIGTERM of the leading master"


async def kill(world: World) -> None:
    """Kill the leading master, etcd's leader, both, or a stand-by, in turn, at any moment of a save."""
    kinds = (_kill_leader, _kill_etcd, _kill_both, _kill_standby)
    on_one_machine = (_kill_leader, _kill_etcd, _kill_one_machine, _kill_standby)
    for number in range(world.rounds(LONG_ROUNDS)):
        for kind in on_one_machine if number % 2 else kinds:
            await asyncio.sleep(world.rng.uniform(0, 0.5))  # at which moment of a save is left to chance
            since = await kind(world)
            await world.until_task_sets_are_back(since)
            await world.whole()


async def _kill_leader(world: World) -> float:
    leader = await world.cluster.leader()
    since = time.monotonic()
    await leader.master.kill()
    return await world.until_written("kill -9 of the leading master", since)


async def _kill_etcd(world: World) -> float:
    leader = await world.cluster.etcd_leader()
    since = time.monotonic()
    await leader.member.kill()
    return await world.until_written("kill -9 of etcd's leader", since)


async def _kill_both(world: World) -> float:
    leader, member = await world.cluster.leader(), await world.cluster.etcd_leader()
    since = time.monotonic()
    await asyncio.gather(leader.master.kill(), member.member.kill())
    return await world.until_written("kill -9 of both", since)


async def _kill_one_machine(world: World) -> float:
    leader = await world.cluster.leader()
    await lead_etcd(world, leader)
    since = time.monotonic()
    await asyncio.gather(leader.master.kill(), leader.member.kill())
    return await world.until_written("kill -9 of both on one machine", since)


async def _kill_standby(world: World) -> float:
    standby = await world.standby()
    since = time.monotonic()
    await standby.master.kill()
    return await world.until_written("kill -9 of a stand-by", since)


async def stop(world: World) -> None:
    """Stop the leading master so long that its lease ends, and let it go on, while clients write and read."""
    async with _stopped(world) as (_, since):
        end = await world.until_written("stop of the leading master", since)
        await world.until_task_sets_are_back(end)
    await world.whole()


async def stop_idle(world: World) -> None:
    """Do so while no client asks for anything: the master that wakes has no request that would tell it."""
    async with world.clients.paused(), _stopped(world) as (leader, _):
        await world.cluster.leader(but=leader)
        await world.until_task_sets_are_back(time.monotonic())
    await world.whole()


@asynccontextmanager
async def _stopped(world: World) -> AsyncIterator[tuple[Machine, float]]:
    """Stop the leading master meanwhile, for a minimum of time; when it goes on, it must notice.

    Yields:
        The machine of the master, and when it was stopped.
    """
    seconds = STOP_S if world.scale == 1 else LONG_STOP_S
    leader = await world.cluster.leader()
    said = len(leader.master.output())
    since = time.monotonic()
    send(leader.master, signal.SIGSTOP)
    try:
        yield leader, since
        await world.cluster.leader(but=leader)
        await asyncio.sleep(max(0.0, since + seconds - time.monotonic()))
    finally:
        world.history.stops.append((leader.name, time.monotonic()))
        send(leader.master, signal.SIGCONT)

    def noticed() -> bool:
        return "leads no more" in leader.master.output()[said:]

    await until(noticed, timeout=PATIENCE_S, what="the master that was stopped says that it leads no more")


async def stop_etcd(world: World) -> None:
    """Stop members of etcd, which end no connection: the one that leads, and those that masters ask first."""
    for _ in range(world.rounds(LONG_ETCD_STOPS)):
        await _stop_member(world, await world.cluster.etcd_leader(), "etcd's leader")
        leader, standby = await world.cluster.leader(), await world.standby()
        await lead_etcd(world, standby)
        await _stop_member(world, leader, "the leading master's member")
        leader, standby = await world.cluster.leader(), await world.standby()
        await lead_etcd(world, leader)
        await _stop_member(world, standby, "a stand-by's member")


async def _stop_member(world: World, machine: Machine, what: str) -> None:
    since = time.monotonic()
    send(machine.member, signal.SIGSTOP)
    try:
        assert not await fetch(f"http://{machine.etcd}/health"), (
            f"the member of {machine.name} is not stopped"
        )
        end = await world.until_written(f"stop of {what}", since)
        await world.until_task_sets_are_back(end)
        await asyncio.sleep(max(0.0, since + STOP_S - time.monotonic()))
    finally:
        send(machine.member, signal.SIGCONT)
    await world.whole()


async def terminate(world: World) -> None:
    """End the leading master with SIGTERM, so that it hands over, at any moment of a save."""
    for _ in range(world.rounds(LONG_ROUNDS)):
        await asyncio.sleep(world.rng.uniform(0, 0.5))
        leader = await world.cluster.leader()
        since = time.monotonic()
        assert await leader.master.stop() == 0
        await world.until_handed_over(leader, since, TERMINATED)
        await world.until_task_sets_are_back(since)
        await world.whole()


async def drain(world: World) -> None:
    """Drain the leading master, as ``rce drain`` does, so that it hands over while it runs on."""
    for _ in range(world.rounds(LONG_ROUNDS)):
        await asyncio.sleep(world.rng.uniform(0, 0.5))
        leader = await world.cluster.leader()
        since = time.monotonic()
        await world.clients.drain(leader, drained=True)
        await world.until_handed_over(leader, since, "drain of the leading master")
        await world.until_task_sets_are_back(since)
        await world.clients.drain(leader, drained=False)
        await world.whole()


async def upgrade(world: World) -> None:
    """End masters and members of etcd in order, one after the other, as an upgrade does."""
    for machine in world.cluster.machines:
        leads = machine is await world.cluster.leader()
        since = time.monotonic()
        assert await machine.master.stop() == 0
        if leads:
            await world.until_handed_over(machine, since, TERMINATED)
        await machine.member.stop()
        await world.clients.wait_for_writes()
        await world.whole()
