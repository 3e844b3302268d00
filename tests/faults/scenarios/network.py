"""Networks that are cut, flap, delay or lose."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, AsyncExitStack

from faults.answers import losing_proxies
from faults.machines import CONTROL_PORT, PEER_PORT, Machine
from faults.networks import dropped, slow, unplugged
from faults.world import World
from rce.config.store_address import ETCD_PORT

CUT_S = 7.0
LONG_CUT_S = 12.0
DELAY_S, LOSS = 0.2, 0.05
SLOW_S = 8.0
LOST_SHARE = 0.05
LOST_WRITES, LONG_LOST_WRITES = 30, 500
LONG_SLOW_S = 60.0


async def cut(world: World) -> None:
    """Cut the leading master off: from all, one way, from etcd only, and from the task sets only."""
    await _cut(world, "machine cut off", lambda machine: unplugged(machine.place))
    await _cut(
        world, "machine hears nothing", lambda machine: dropped([machine.place], ("INPUT", "-i", "eth0"))
    )
    await _cut(
        world, "machine says nothing", lambda machine: dropped([machine.place], ("OUTPUT", "-o", "eth0"))
    )
    from_etcd = [
        (chain, "-p", "tcp", way, str(ETCD_PORT))
        for chain, way in (("OUTPUT", "--dport"), ("INPUT", "--sport"))
    ]
    await _cut(
        world,
        "master cut off from etcd",
        lambda machine: dropped([machine.place], *from_etcd),
        from_clients=False,
    )


async def _cut(
    world: World,
    what: str,
    make: Callable[[Machine], AbstractContextManager[None]],
    *,
    from_clients: bool = True,
) -> None:
    leader = await world.cluster.leader()
    with make(leader):
        since = time.monotonic()
        end = await world.until_written(what, since)
        await world.until_task_sets_are_back(end)
        await asyncio.sleep(max(0.0, since + _seconds(world) - time.monotonic()))
    if from_clients:
        world.history.cuts.append((leader.name, since, time.monotonic()))
    await world.whole()


def _seconds(world: World) -> float:
    return CUT_S if world.scale == 1 else LONG_CUT_S


async def cut_from_task_sets(world: World) -> None:
    """Cut the leading master off from all task sets, which must stay as they are until they hear it again."""
    leader = await world.cluster.leader()
    with dropped([leader.place], ("INPUT", "-p", "tcp", "--dport", str(CONTROL_PORT))):
        await asyncio.sleep(_seconds(world))
        await world.clients.wait_for_writes()  # clients still reach it
    await world.until_task_sets_are_back(time.monotonic())


async def cut_etcd_apart(world: World) -> None:
    """Cut the members of etcd off from each other: no master can write, and all come back."""
    peers = [
        ("INPUT", "-p", "tcp", "--dport", str(PEER_PORT)),
        ("INPUT", "-p", "tcp", "--sport", str(PEER_PORT)),
    ]
    places = [machine.place for machine in world.cluster.machines]
    with dropped(places, *peers):
        await asyncio.sleep(_seconds(world))
        await world.until_no_master_leads()
    since = time.monotonic()
    end = await world.until_written("members of etcd apart, and back", since)
    await world.until_task_sets_are_back(end)


async def flap(world: World) -> None:
    """Pull the leading master's cable and put it back each second."""
    leader = await world.cluster.leader()
    since = time.monotonic()
    for _ in range(round(_seconds(world) / 2)):
        with unplugged(leader.place):
            await asyncio.sleep(1.0)
        await asyncio.sleep(1.0)
    world.history.cuts.append((leader.name, since, time.monotonic()))
    await world.until_written("flapping cable", time.monotonic())


async def delay(world: World) -> None:
    """Delay and lose packets of one machine after the other; then of all."""
    term = (await (await world.cluster.leader()).health())["term"]
    async with AsyncExitStack() as stack:
        for number, machine in enumerate(
            world.cluster.machines[:1] if world.scale == 1 else world.cluster.machines
        ):
            await stack.enter_async_context(
                slow(machine.place, world.rng.randrange(1000), delay=DELAY_S, loss=LOSS, tag=str(number))
            )
        await asyncio.sleep(SLOW_S if world.scale == 1 else LONG_SLOW_S)
        await world.clients.wait_for_writes()
        now = (await (await world.cluster.leader()).health())["term"]
        world.times.add(f"terms begun under {DELAY_S * 1e3:g} ms and {LOSS:.0%}", now - term)


async def lose_answers(world: World) -> None:
    """Lose answers of etcd, with their connections: saves are done, and the masters are not told of it."""
    cluster = world.cluster
    async with losing_proxies(cluster.machines, cluster.client.address, world.rng) as proxies:
        await _restart(world, f"etcd://{','.join(proxies.values())}")
        for proxy in proxies:
            proxy.share = LOST_SHARE
        await world.clients.wait_for_writes(LOST_WRITES if world.scale == 1 else LONG_LOST_WRITES)
        for proxy in proxies:
            proxy.share = 0.0
        since = time.monotonic()
        await world.until_written("lost answers of etcd", since)
        await world.whole()
        assert sum(proxy.lost for proxy in proxies) > 0, "no answer was lost"
        await _restart(world, "")


async def _restart(world: World, store: str) -> None:
    """Let all masters use another address of the store."""
    for machine in world.cluster.machines:
        machine.store = store
        await machine.master.stop()
        await world.whole()
