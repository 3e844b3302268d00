"""``rce exec`` when another master takes the lead."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import msgspec
import psutil
import pytest
from support.engine import until
from support.etcd import cluster
from support.masters import DEV_USER, MasterProcess, masters
from support.replicated import TIMEOUT_S, task_sets

from rce.control.execution import Command, Part, decode

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd"), pytest.mark.timeout(600)]

ENDLESS = "sleep 6547"


@contextlib.contextmanager
def hanging(master: MasterProcess) -> Iterator[None]:
    """Stop a master, whose machine goes on to take what is sent to it."""
    master.send(signal.SIGSTOP)
    try:
        yield
    finally:
        master.send(signal.SIGCONT)


def works() -> bool:
    """Return whether the command is there."""
    return any(process.info["cmdline"] == ENDLESS.split() for process in psutil.process_iter(["cmdline"]))


async def test_command_ends_when_its_master_hangs_and_another_leads(folder: Path) -> None:
    """The former master closes no connection, and its user cannot end the command."""
    async with (
        cluster(folder / "etcd", 3) as etcd,
        masters(folder / "masters", etcd.store) as all_,
        task_sets(folder, all_, robots=1),
    ):
        leader = await all_.leader()
        await all_.log_in()

        async def runs() -> bool:
            async with all_.session() as session, session.get(f"{leader.url}api/v1/containers") as reply:
                found = (await reply.json())["containers"]
            return [each["state"] for each in found] == ["running"]

        code, text = await all_.ask("POST", f"{leader.url}api/v1/containers", json={"tag": "box"})
        assert code < 300, text
        await until(runs, timeout=TIMEOUT_S, what=f"the container of {DEV_USER} runs")
        async with (
            aiohttp.ClientSession(headers={"Authorization": f"Bearer {all_.token}"}) as session,
            session.ws_connect(f"{leader.url}api/v1/containers/box/exec") as user,
        ):
            command = Command(argv=tuple(ENDLESS.split()))
            await user.send_str(msgspec.json.encode(command).decode())
            frame = decode((await user.receive(TIMEOUT_S)).data)
            assert frame.part is Part.STARTED, frame
            await until(works, timeout=TIMEOUT_S, what="the command runs")
            with hanging(leader):
                await all_.leader(but=leader)
                await until(lambda: not works(), timeout=TIMEOUT_S, what="the command is ended")
