"""Networks that are cut, flap, delay or lose."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractContextManager, AsyncExitStack, ExitStack, asynccontextmanager
from typing import TypeAlias

from support.engine import until

from faults.answers import losing_proxies
from faults.goals import WITH_ETCD
from faults.machines import CONTROL_PORT, PATIENCE_S, PEER_PORT, Machine, is_reached
from faults.networks import FROM_ETCD, between, dropped, slow, unplugged
from faults.scenarios.etcd import lead_etcd
from faults.world import World
from rce.config.store_address import ETCD_PORT

CUT_S = 7.0
LONG_CUT_S = 12.0
LONG_ROUNDS = 12
"""Of each kind of cut."""
LONG_PAIRS = 20
Cut: TypeAlias = Callable[[Machine], AbstractContextManager[None]]
Rules: TypeAlias = Sequence[Sequence[str]]
BOTH_WAYS = ("INPUT", "OUTPUT")
WAYS = (BOTH_WAYS, ("INPUT",), ("OUTPUT",))
PORTS = (ETCD_PORT, PEER_PORT, CONTROL_PORT, None)
ALL = (("INPUT", "-i", "eth0"), ("OUTPUT", "-o", "eth0"))
"""Rules that cut a machine off from all others."""
DELAY_S, LOSS = 0.2, 0.05
DELAY_OF_ALL_S, LOSS_OF_ALL = 0.05, 0.01
"""Packets from one machine to another are delayed at both: a round trip takes four times as long."""
SLOW_S = 8.0
LOST_SHARE = 0.05
LOST_WRITES, LONG_LOST_WRITES = 30, 500
LONG_SLOW_S = 60.0


async def cut(world: World) -> None:
    """Cut the leading master off from all, one way, and from etcd; every second time with etcd's leader."""
    for number in range(world.rounds(LONG_ROUNDS)):
        for what, make in CUTS.items():
            await _cut(world, what, make, with_etcd=number % 2 == 1)


async def _cut(world: World, what: str, make: Cut, *, with_etcd: bool) -> None:
    leader = await world.cluster.leader()
    if with_etcd:
        await lead_etcd(world, leader)
        what += WITH_ETCD
    await asyncio.sleep(world.rng.uniform(0, 0.5))
    with make(leader):
        since = time.monotonic()
        end = await world.until_written(what, since)
        await world.cluster.leader(but=leader)
        await world.until_task_sets_are_back(end)
        await asyncio.sleep(max(0.0, since + _seconds(world) - time.monotonic()))
        term = await world.term()
    if make is not cut_from_etcd:
        world.history.cuts.append((leader.name, since, time.monotonic()))
    await world.whole()
    world.times.add("terms begun when it is back", await world.term() - term)


def cut_from_etcd(machine: Machine) -> AbstractContextManager[None]:
    """Cut a master off from all members of etcd; clients reach it."""
    return dropped([machine.place], *FROM_ETCD)


CUTS: dict[str, Cut] = {
    "machine cut off": lambda machine: unplugged(machine.place),
    "machine hears nothing": lambda machine: dropped([machine.place], ("INPUT", "-i", "eth0")),
    "machine says nothing": lambda machine: dropped([machine.place], ("OUTPUT", "-o", "eth0")),
    "master cut off from etcd": cut_from_etcd,
}


async def cut_pairs(world: World) -> None:
    """Cut machines off from single others: one or both ways, at one port or all, several pairs at once."""
    machines = world.cluster.machines
    one, other, _ = world.rng.sample(machines, 3)
    await _cut_some(world, [(one, between(other.place, None, BOTH_WAYS))])
    leader = await world.cluster.etcd_leader()
    peers = [each.place for each in machines if each is not leader]
    await _cut_some(world, [(leader, between(peer, PEER_PORT, BOTH_WAYS)) for peer in peers])
    await _cut_some(world, [(await world.standby(), ALL)])
    await _cut_some(world, [(each, ALL) for each in world.rng.sample(machines, 2)])
    for _ in range(world.rounds(LONG_PAIRS)):
        await _cut_some(world, [_draw(world) for _ in range(world.rng.randint(1, 4))])


def _draw(world: World) -> tuple[Machine, Rules]:
    """Choose a machine, and rules that cut it off from another one."""
    rng, cluster = world.rng, world.cluster
    machine = rng.choice(cluster.machines)
    others = [*(each.place for each in cluster.machines if each is not machine), cluster.server]
    return machine, between(rng.choice(others), rng.choice(PORTS), rng.choice(WAYS))


async def _cut_some(world: World, cuts: Sequence[tuple[Machine, Rules]]) -> None:
    since = time.monotonic()
    with ExitStack() as stack:
        for machine, rules in cuts:
            stack.enter_context(dropped([machine.place], *rules))
        await asyncio.sleep(world.rng.uniform(2.0, CUT_S))
    end = time.monotonic()
    world.history.cuts += [(machine.name, since, end) for machine, rules in cuts if rules is ALL]
    written = await world.until_written("pairs of machines cut off, and back", end)
    await world.until_task_sets_are_back(written)
    await world.whole()


def _seconds(world: World) -> float:
    return CUT_S if world.scale == 1 else LONG_CUT_S


async def cut_from_task_sets(world: World) -> None:
    """Cut the leading master off from all task sets, which must stay as they are until they hear it again."""

    async def none_is_connected() -> bool:
        return await world.connected_task_sets() == 0

    leader = await world.cluster.leader()
    with dropped([leader.place], ("INPUT", "-p", "tcp", "--dport", str(CONTROL_PORT))):
        await asyncio.sleep(_seconds(world))
        await until(none_is_connected, timeout=PATIENCE_S, what="the leading master misses all task sets")
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
            reached, _ = await asyncio.gather(is_reached(leader), asyncio.sleep(1.0))
            assert not reached, "the cable is not out"
        await asyncio.sleep(1.0)
    world.history.cuts.append((leader.name, since, time.monotonic()))
    await world.until_written("flapping cable", time.monotonic())


async def delay(world: World) -> None:
    """Delay and lose packets of one machine after the other, which moves no lead; then of all.

    etcd's leader is on another one: two streams that each stall at every loss are slower than a lease lasts.
    """
    machines = world.cluster.machines
    for machine in machines[:1] if world.scale == 1 else machines:
        await lead_etcd(world, world.rng.choice([each for each in machines if each is not machine]))
        what = f"{DELAY_S * 1e3:g} ms and {LOSS:.0%} at one"
        async with _delayed(world, machine, DELAY_S, LOSS), world.lead_stays(what):
            await asyncio.sleep(SLOW_S if world.scale == 1 else LONG_SLOW_S)
            await world.clients.wait_for_writes()
    if world.scale == 1:
        return
    async with AsyncExitStack() as stack:
        for machine in machines:
            await stack.enter_async_context(_delayed(world, machine, DELAY_OF_ALL_S, LOSS_OF_ALL))
        term = await world.term()
        await asyncio.sleep(LONG_SLOW_S)
        await world.clients.wait_for_writes()
        what = f"terms begun under {DELAY_OF_ALL_S * 1e3:g} ms and {LOSS_OF_ALL:.0%} at all"
        world.times.add(what, await world.term() - term)


@asynccontextmanager
async def _delayed(world: World, machine: Machine, delay: float, loss: float) -> AsyncIterator[None]:
    """Delay each packet of a machine by so many seconds, and lose a share, until it is left."""
    since = time.monotonic()
    seed = world.rng.randrange(1000)
    async with slow(machine.place, seed, delay=delay, loss=loss, tag=machine.name):
        asked = time.monotonic()
        await machine.health()
        assert time.monotonic() - asked > 2 * delay, f"packets of {machine.name} are not delayed"
        yield
    world.history.cuts.append((machine.name, since, time.monotonic()))


async def lose_answers(world: World) -> None:
    """Lose answers of etcd, with their connections: saves are done, and the masters are not told of it."""
    cluster = world.cluster
    async with losing_proxies(cluster.machines, cluster.client.address, world.seed) as proxies:
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
