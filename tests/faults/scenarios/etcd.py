"""All of etcd away, a member that is replaced, a restored copy, full and slow disks, and other clocks."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import shutil
import subprocess
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import aiohttp
from support.engine import until

from faults.machines import PATIENCE_S, PEER_PORT, Machine
from faults.networks import FROM_ETCD, dropped
from faults.world import World
from rce_master.events import IDS_OF_TERM
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.exceptions import EtcdAwayError, EtcdRefusedError
from rce_master.store.etcd.wire import Delete, Put

AWAY_S = 8.0
LONG_AWAY_S = 120.0
FSYNC_S = 0.5
FSYNC_METRIC = "etcd_disk_wal_fsync_duration_seconds"
SLOW_S = 6.0
LONG_SLOW_S = 60.0
QUOTA = 16 << 20
"""Bytes of a database that is soon full."""
BALLAST = 1 << 20
DISK = "200m"
FAKETIME = "faketime/libfaketime.so.1"
"""In the folder of an architecture's libraries."""
CLOCKS = ("+1h", "-1h")
JUMPS = {"+1h": 3600.0, "-1h": -3600.0, "+0": 0.0}
"""What libfaketime is told, and seconds."""
NEAR_S = 60.0
LONG_JUMPS = 5
_SOURCE = Path(__file__).parent.parent / "slow_fsync.c"


async def away(world: World) -> None:
    """End all members of etcd, and start them again; let them forget revisions that a stand-by misses."""
    for machine in world.cluster.machines:
        await machine.member.kill()
    await asyncio.sleep(AWAY_S if world.scale == 1 else LONG_AWAY_S)
    await world.until_no_master_leads()
    for machine in world.cluster.machines:
        await world.clients.check_refusal(machine)
    since = time.monotonic()
    for machine in world.cluster.machines:
        await machine.start_etcd(world.cluster.machines)
    end = await world.until_written("etcd away, and back", since)
    await world.until_task_sets_are_back(end)
    await world.whole()
    await miss_revisions(world)


async def miss_revisions(world: World) -> None:
    """Cut a stand-by off from etcd until what it misses is forgotten: it must load its copy anew."""
    standby = await world.standby()
    said = len(standby.master.output())

    async def misses_etcd() -> bool:
        return "etcd" in (await standby.health()).get("status", "")

    with dropped([standby.place], *FROM_ETCD):
        await until(misses_etcd, timeout=PATIENCE_S, what=f"the master of {standby.name} misses etcd")
        await world.clients.wait_for_writes()
        # A member asks itself at the port that is cut, so another one has to be told.
        await compact([each for each in world.cluster.machines if each is not standby])
    await until(
        lambda: "loads its copy of the state anew: etcd has compacted" in standby.master.output()[said:],
        timeout=PATIENCE_S,
        what=f"the master of {standby.name} loads its copy anew",
    )
    await world.whole()


async def compact(machines: list[Machine]) -> None:
    """Let etcd forget all revisions but the newest."""
    async with EtcdClient([each.etcd for each in machines], attempt=10.0) as client:
        revision = (await client.range("/", limit=1)).revision
    await post(machines[0], "v3/kv/compaction", {"revision": str(revision), "physical": True})


async def clocks(world: World) -> None:
    """Let one master's clock be an hour ahead, and another one's an hour behind; both lead in turn."""
    async with world.clients.events() as ids:
        await _lead_with_wrong_clocks(world)
    assert all(before < after for before, after in itertools.pairwise(ids)), f"ids do not grow: {ids}"
    terms = {event // IDS_OF_TERM for event in ids}
    assert len(terms) > len(CLOCKS), f"events of too few terms: {sorted(terms)}"


async def _lead_with_wrong_clocks(world: World) -> None:
    for jump in CLOCKS:
        leader = await world.cluster.leader()
        right = [each for each in world.cluster.machines if each is not leader and not each.master_env]
        machine = world.rng.choice(right)
        machine.master_env = _wrong_clock(FAKETIME=jump)
        await machine.master.stop()
        await world.whole()
        await _check_clock(machine, jump)
    wrong = [machine for machine in world.cluster.machines if machine.master_env]
    for machine in [each for each in world.cluster.machines if each not in wrong]:
        await machine.master.stop()  # so that one with a wrong clock leads
    leader = await world.cluster.leader()
    assert leader in wrong
    await world.clients.wait_for_writes(10)
    await leader.master.kill()
    other = await world.cluster.leader(but=leader)
    assert other in wrong
    await world.clients.wait_for_writes(10)
    for machine in wrong:
        machine.master_env = {}
        if machine.master.running:
            await machine.master.kill()
        await world.whole()


def _wrong_clock(**how: str) -> dict[str, str]:
    """Return the environment of a master with another clock.

    Raises:
        FileNotFoundError: libfaketime is missing; a preloaded library that is missing would change no clock.
    """
    faketime = next((str(path) for path in Path("/usr/lib").glob(f"*/{FAKETIME}")), None)
    if faketime is None:
        raise FileNotFoundError("libfaketime.so.1 is missing (Debian: faketime)")
    return {"LD_PRELOAD": faketime, "FAKETIME_DONT_FAKE_MONOTONIC": "1", **how}


async def clock_jumps(world: World) -> None:
    """Set the clocks of all masters ahead and back while they run: leases are timed by another clock."""
    file = world.cluster.folder / "clock"
    file.write_text("+0\n")
    for machine in world.cluster.machines:
        machine.master_env = _wrong_clock(FAKETIME_TIMESTAMP_FILE=str(file), FAKETIME_NO_CACHE="1")
        await machine.master.stop()
        await world.whole()
    async with world.lead_stays("clocks that jump"):
        for jump in list(JUMPS) * (1 if world.scale == 1 else LONG_JUMPS):
            file.write_text(f"{jump}\n")
            await _check_clock(await world.cluster.leader(), jump)
            since = time.monotonic()
            await world.until_written(f"clocks at {jump}", since)
            await world.clients.wait_for_writes(10)
    for machine in world.cluster.machines:
        machine.master_env = {}
        await machine.master.stop()
        await world.whole()


async def _check_clock(machine: Machine, jump: str) -> None:
    """Check that the clock of a machine's master is wrong by one of :data:`JUMPS`."""
    async with aiohttp.ClientSession() as session, session.get(f"{machine.url}healthz") as reply:
        shown = parsedate_to_datetime(reply.headers["Date"]).timestamp()
    difference = shown - time.time()
    assert abs(difference - JUMPS[jump]) < NEAR_S, f"the clock of {machine.name} is {difference:+.0f} s wrong"


async def slow_disk(world: World) -> None:
    """Let each fsync take half a second: at a member that follows, then at the one that leads.

    The others are more than half without a slow follower. A slow leader may delay all; it must lose nothing.
    """
    launcher, flag = build_slow_fsync(world), world.cluster.folder / "slow"
    leader = await world.cluster.etcd_leader()
    follower = world.rng.choice([each for each in world.cluster.machines if each is not leader])
    fault = f"fsync of {FSYNC_S:g} s at"
    async with slowed(world, follower, launcher, flag):
        term = await world.term()
        since = time.monotonic()
        await world.until_written(f"{fault} a follower of etcd", since)
        await asyncio.sleep(SLOW_S if world.scale == 1 else LONG_SLOW_S)
        await world.clients.wait_for_writes()
        world.times.add(f"terms begun under {fault} a follower", await world.term() - term)
    async with slowed(world, follower, launcher, flag, leads=True):
        term = await world.term()
        await asyncio.sleep(SLOW_S if world.scale == 1 else LONG_SLOW_S)
        since = time.monotonic()
    await world.until_written(f"{fault} etcd's leader, and back", since)
    world.times.add(f"terms begun under {fault} etcd's leader", await world.term() - term)


def build_slow_fsync(world: World) -> Path:
    """Compile the program that starts others with a slow fsync; return its path."""
    launcher = world.cluster.folder / "slow_fsync"
    subprocess.run(["gcc", "-O1", "-o", launcher, _SOURCE], check=True)
    return launcher


@asynccontextmanager
async def slowed(
    world: World, machine: Machine, launcher: Path, flag: Path, *, leads: bool = False
) -> AsyncIterator[None]:
    """Let a member's disk be slow until it is left."""
    machine.etcd_launcher = (str(launcher), str(flag), f"{FSYNC_S * 1e3:g}")
    await machine.member.kill()
    await world.whole()
    if leads:
        await lead_etcd(world, machine)
    flag.touch()
    count, seconds = await fsyncs(machine)
    yield
    now, in_all = await fsyncs(machine)
    assert now > count, f"the member of {machine.name} wrote nothing to its disk"
    assert (in_all - seconds) / (now - count) > FSYNC_S / 2, f"the disk of {machine.name} is not slow"
    flag.unlink()
    machine.etcd_launcher = ()


async def fsyncs(machine: Machine) -> tuple[int, float]:
    """Return how often a member has waited for its log to be on its disk, and how many seconds in all."""
    async with aiohttp.ClientSession() as session, session.get(f"http://{machine.etcd}/metrics") as reply:
        lines = (await reply.text()).splitlines()
    found = dict(line.rsplit(" ", 1) for line in lines if line.startswith(FSYNC_METRIC))
    return int(float(found[f"{FSYNC_METRIC}_count"])), float(found[f"{FSYNC_METRIC}_sum"])


async def lead_etcd(world: World, chosen: Machine) -> None:
    """Let a member of etcd lead."""

    number = (await post(chosen, "v3/maintenance/status", {}))["header"]["member_id"]

    async def leads() -> bool:
        leader = await world.cluster.etcd_leader()
        if leader is not chosen:
            with contextlib.suppress(AssertionError):  # refused while another election is under way
                await post(leader, "v3/maintenance/transfer-leadership", {"targetID": number})
        return leader is chosen

    await until(leads, timeout=PATIENCE_S, what=f"the member of {chosen.name} leads")


async def replace_member(world: World) -> None:
    """Lose the data of a machine's member and master for good, and put empty ones in their place."""
    lost, *others = world.rng.sample(world.cluster.machines, len(world.cluster.machines))
    since = time.monotonic()
    await asyncio.gather(lost.member.kill(), lost.master.kill())
    shutil.rmtree(lost.data / "data")
    shutil.rmtree(lost.state)
    await world.until_written("a machine and its disk lost", since)
    members = (await post(others[0], "v3/cluster/member/list", {}))["members"]
    (number,) = [each["ID"] for each in members if each.get("name") == lost.name]
    await post(others[0], "v3/cluster/member/remove", {"ID": number})
    url, body = (
        f"http://{others[0].etcd}/v3/cluster/member/add",
        {"peerURLs": [f"http://{lost.address}:{PEER_PORT}"]},
    )

    async def added() -> bool:
        """etcd refuses it until the others have been connected for some seconds."""
        async with aiohttp.ClientSession() as session, session.post(url, json=body) as reply:
            return reply.status == 200

    await until(added, timeout=PATIENCE_S, what="the new member is accepted")
    lost.cluster_state = "existing"
    await lost.start_etcd(world.cluster.machines)
    await world.whole()


async def full_disk(world: World) -> None:
    """Fill the disk of a member, which ends then; then of a second one; and make room again.

    Segments of etcd's log are reserved in advance, so a member ends when the next one or its database grows.
    """
    first, second, _ = world.rng.sample(world.cluster.machines, 3)
    with small_disk(world, first) as one, small_disk(world, second) as two:
        ballast = {first: one / "ballast", second: two / "ballast"}
        await move_data(world, first, one)
        await move_data(world, second, two)
        await fill(ballast[first])
        await grow(world, first)
        await world.clients.wait_for_writes(10)
        await fill(ballast[second])
        await grow(world, second)
        await world.until_no_master_leads()
        since = time.monotonic()
        for machine, file in ballast.items():
            file.unlink()
            await machine.start_etcd(world.cluster.machines)
        await world.until_written("two full disks, and room again", since)
        await move_data(world, first, world.cluster.folder / "moved-first")
        await move_data(world, second, world.cluster.folder / "moved-second")


async def full_database(world: World) -> None:
    """Let etcd's database reach its quota: the masters say so, and work again once there is room."""
    for machine in world.cluster.machines:
        machine.etcd_options = ("--quota-backend-bytes", str(QUOTA))
        await machine.member.kill()
        await world.cluster.repair()
    leader = await world.cluster.leader()
    async with EtcdClient([each.etcd for each in world.cluster.machines], attempt=10.0) as client:
        number = 0
        with contextlib.suppress(EtcdRefusedError):
            while True:
                number += 1
                await client.transact([], [Put(f"/ballast/{number}", b"x" * BALLAST)])

        async def told() -> bool:
            url = f"{leader.url}api/v1/robot-tokens"
            body = {"robot": "no_room"}
            async with world.clients.session(10.0) as session, session.post(url, json=body) as reply:
                return reply.status == 503 and "etcdctl alarm disarm" in await reply.text()

        await until(told, timeout=PATIENCE_S, what="the master says that etcd's database is full")
        await compact(world.cluster.machines)
        deletes = [Delete(f"/ballast/{each}") for each in range(1, number + 1)]
        await client.transact([], deletes)
        await compact(world.cluster.machines)
    for machine in world.cluster.machines:
        await post(machine, "v3/maintenance/defragment", {})
        machine.etcd_options = ()
    for alarm in (await post(world.cluster.machines[0], "v3/maintenance/alarm", {"action": "GET"}))["alarms"]:
        await post(world.cluster.machines[0], "v3/maintenance/alarm", {**alarm, "action": "DEACTIVATE"})
    since = time.monotonic()
    await world.until_written("etcd's database full, and emptied", since)


async def post(machine: Machine, path: str, body: object) -> dict[str, Any]:
    """Ask a member of etcd."""
    url, timeout = f"http://{machine.etcd}/{path}", aiohttp.ClientTimeout(total=60.0)
    async with aiohttp.ClientSession(timeout=timeout) as session, session.post(url, json=body) as reply:
        found: dict[str, Any] = await reply.json(content_type=None)
        assert reply.status == 200, found
        return found


@contextmanager
def small_disk(world: World, machine: Machine) -> Iterator[Path]:
    """Make a small disk for a machine, which nothing may use at the end."""
    path = world.cluster.folder / f"disk-{machine.name}"
    path.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", path], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", path], check=True)


async def move_data(world: World, machine: Machine, folder: Path) -> None:
    """Move a member's data to another folder."""
    await machine.member.kill()
    await asyncio.to_thread(shutil.copytree, machine.data, folder / "etcd")
    machine.data = folder / "etcd"
    await world.whole()


async def grow(world: World, machine: Machine) -> None:
    """Write to etcd until a member that has no room for it ends."""
    others = [each.etcd for each in world.cluster.machines if each is not machine]
    async with EtcdClient(others, attempt=10.0) as client:

        async def ended() -> bool:
            with contextlib.suppress(EtcdAwayError):
                await client.transact([], [Put("/ballast/grow", os.urandom(BALLAST))])
            return not machine.member.running

        await until(ended, timeout=PATIENCE_S, what=f"the member of {machine.name} ends for its full disk")


async def fill(file: Path) -> None:
    """Fill a disk to the last byte; the robot, whose pauses are timed, talks meanwhile."""
    await asyncio.to_thread(_fill, file)


def _fill(file: Path) -> None:
    with file.open("wb", buffering=0) as ballast, contextlib.suppress(OSError):
        while True:
            ballast.write(bytes(1 << 12))
