"""Disks of masters that are slow or full: they hold archives of packages and the audit log."""

from __future__ import annotations

import asyncio
import os
import time

from support.engine import until
from support.user_packages import KEY, pack, sign, write_package

from faults.clients import USER
from faults.machines import PATIENCE_S, Machine
from faults.scenarios.etcd import FSYNC_S, LONG_SLOW_S, SLOW_S, build_slow_fsync, fill, small_disk
from faults.world import World

PACKAGE_BYTES = 3 << 20
"""Random ones, which no archive makes smaller."""
UNAVAILABLE = 503


async def slow_disk(world: World) -> None:
    """Let each fsync of the leading master take half a second while packages are pushed: it must lead on."""
    launcher, flag = build_slow_fsync(world), world.cluster.folder / "slow-master"
    slow = world.rng.choice(world.cluster.machines)
    slow.master_launcher = (str(launcher), str(flag), f"{FSYNC_S * 1e3:g}")
    await slow.master.kill()
    await world.whole()
    await lead(world, slow)
    await register_key(world, slow)
    async with world.lead_stays("a master's slow disk"):
        flag.touch()
        end = time.monotonic() + (SLOW_S if world.scale == 1 else LONG_SLOW_S)
        number = 0
        while time.monotonic() < end:
            number += 1
            since = time.monotonic()
            assert await push(world, slow, f"slow{number}") == 200
            seconds = time.monotonic() - since
            assert seconds > FSYNC_S, "the disk is not slow"
            world.times.add(f"push, fsync of {FSYNC_S:g} s at a master", seconds)
            await world.clients.wait_for_writes()
        flag.unlink()
    slow.master_launcher = ()
    await slow.master.kill()
    await world.whole()


async def full_disk(world: World) -> None:
    """Fill the disk of the leading master, then that of a stand-by, then both; and make room again.

    Writes of the state continue. A package is accepted if more than half of the masters have room for it.
    """
    first, second = world.rng.sample(world.cluster.machines, 2)
    with small_disk(world, first) as one, small_disk(world, second) as two:
        for machine, path in ((first, one), (second, two)):
            machine.master_state = path / "master"
            await machine.master.kill()
            await world.whole()
        await lead(world, first)
        await register_key(world, first)
        async with world.lead_stays("a master's full disk"):
            assert await push(world, first, "room") == 200
            await fill(two / "ballast")
            assert await push(world, first, "full_standby") == 200
            await fill(one / "ballast")
            assert await push(world, first, "full_both") == UNAVAILABLE
            await world.clients.wait_for_writes(10)
            (two / "ballast").unlink()
            assert await push(world, first, "full_leader") == UNAVAILABLE
            await world.clients.wait_for_writes(10)
        await first.master.kill()  # one begins, and follows, on a full disk
        await world.whole()
        (one / "ballast").unlink()
        leader = await world.cluster.leader()

        async def is_pushed() -> bool:
            return await push(world, leader, "room_again") == 200

        await until(is_pushed, timeout=PATIENCE_S, what="a package is accepted when there is room")
        for machine in (first, second):
            machine.master_state = None
            await machine.master.kill()
            await world.whole()


async def lead(world: World, chosen: Machine) -> None:
    """Let the master of a machine lead."""

    async def leads() -> bool:
        leader = await world.cluster.leader()
        if leader is not chosen:
            await leader.master.stop()
            await world.cluster.repair()
        return leader is chosen

    await until(leads, timeout=PATIENCE_S, what=f"the master of {chosen.name} leads")


async def register_key(world: World, machine: Machine) -> None:
    """Let the user sign packages."""
    url, body = f"{machine.url}api/v1/package-keys", {"key": KEY.public, "label": "faults"}
    async with world.clients.session() as session, session.post(url, json=body) as reply:
        assert reply.status == 201, await reply.text()


async def push(world: World, machine: Machine, name: str) -> int:
    """Push a package to a master; return the status of the answer."""
    folder = world.cluster.folder / "packages"
    package = write_package(folder, name, nodes__run="pass\n")
    await asyncio.to_thread((package / "data").write_bytes, os.urandom(PACKAGE_BYTES))
    archive = await asyncio.to_thread(pack, package)
    spec = sign(archive, name, "1.0", USER)
    url, query = (
        f"{machine.url}api/v1/packages/{name}/1.0",
        {"key": spec.key, "signature": spec.signature},
    )
    async with (
        world.clients.session(PATIENCE_S) as session,
        session.put(url, params=query, data=archive) as reply,
    ):
        text = await reply.text()
        assert reply.status in (200, UNAVAILABLE), text
        assert reply.status == 200 or "No space left on device" in text, text
        return reply.status
