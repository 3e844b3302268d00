"""Masters and task sets are restarted one after the other, under traffic of robots and of users."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from support.engine import command_line, engine_processes, until
from support.etcd import cluster
from support.masters import DEV_USER, masters
from support.replicated import TIMEOUT_S, Caller, task_sets

from rce_client import Connection

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd"), pytest.mark.timeout(900)]


def node(folder: Path) -> int:
    """Return the process of the container's node."""
    (found,) = {
        process.pid
        for process in engine_processes(folder)
        if any(word.endswith("stringEcho.py") for word in command_line(process))
    }
    return found


async def test_each_part_is_restarted(folder: Path) -> None:
    async with (
        cluster(folder / "etcd", 3) as etcd,
        masters(folder / "masters", etcd.store) as all_,
        task_sets(folder, all_) as (*robot_sets, containers),
        Connection([master.url for master in all_.all], DEV_USER, DEV_USER, "robot") as robot,
        Caller.calling(robot) as caller,
    ):
        await caller.wait_for_answers()
        pid = node(folder)
        leader = await all_.leader()
        for master in [*(one for one in all_.all if one is not leader), leader]:
            async with all_.under_load():  # anew for each: a writer makes a limited number of writes
                await all_.wait_for_writes()
                await master.stop()
                await all_.wait_for_writes()
            await caller.wait_for_answers()
            await master.start(ready="rce-master stand-by: ")
        assert not caller.failed, "a restart of a master touched links"
        for program in robot_sets:
            await program.stop()
            await caller.wait_for_answers()
            await program.start()
        failed = caller.failed
        assert containers.process is not None
        containers.process.send_signal(signal.SIGUSR1)
        await until(
            lambda: containers.output().count(" ready: ") > 1,
            timeout=TIMEOUT_S,
            what="the container task set has restarted",
        )
        await caller.wait_for_answers()
        assert caller.failed == failed, "the restart of the container task set touched links"
        async with all_.under_load():
            await all_.wait_for_writes()
        assert node(folder) == pid, "the container was made again"
        await all_.check_nothing_is_lost()
