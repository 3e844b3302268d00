"""All of etcd's data is lost, and a backup is restored."""

from __future__ import annotations

import asyncio
import shutil
import sys
import time
from pathlib import Path

from faults.machines import Machine
from faults.world import World


async def restore(world: World) -> None:
    """Restore a backup to a new etcd while task sets run, which keep their robots and containers.

    What is written after a backup is lost with etcd, so clients pause from the one to the other.
    """
    machines = world.cluster.machines
    file = world.cluster.folder / "backup.tar"
    at = await world.cluster.leader()
    async with world.clients.paused():
        await _rce(world, at, "backup", file)
        for machine in machines:
            await machine.master.kill()
            await machine.member.kill()
        since = time.monotonic()
        for machine in machines:
            shutil.rmtree(machine.data)
            machine.data.mkdir()
            await machine.start_etcd(machines)
        await _rce(world, at, "restore", file)
        await asyncio.gather(*map(world.cluster.start_master, machines))
        await world.cluster.leader()
    await world.until_written("a restored backup", since)
    await world.until_task_sets_are_back(since)
    await world.whole()


async def _rce(world: World, at: Machine, command: str, file: Path) -> None:
    """Run ``rce backup`` or ``rce restore`` on the machine of a master."""
    options = ("--store", world.cluster.store_of(at), "--state-dir", str(at.state))
    process = await asyncio.create_subprocess_exec(
        *at.place.prefix,
        *(str(Path(sys.executable).parent / "rce"), command, str(file), *options),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env=at.env,
    )
    output, _ = await process.communicate()
    assert process.returncode == 0, f"rce {command}: {output.decode()}"
