"""The switch of a group: a container that cannot be connected leaves it usable for the others."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.model import EndpointId
from rce_container.exceptions import NetworkError
from rce_container.network import Networks
from rce_container.network.namespaces import configure, open_namespace
from rce_container.network.networks import Membership

pytestmark = pytest.mark.needs("root", "netns")


@pytest.fixture
def networks() -> Iterator[Networks]:
    made = Networks()
    yield made
    made.close()


@pytest.fixture
def members() -> Iterator[list[int]]:
    """Processes in network namespaces of their own."""
    with contextlib.ExitStack() as stack:
        pids = []
        for _ in range(2):
            process = stack.enter_context(
                subprocess.Popen(
                    ["unshare", "--net", "sh", "-c", "echo; exec sleep 600"], stdout=subprocess.PIPE
                )
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            process.stdout.readline()
            pids.append(process.pid)
        yield pids


def enroll(networks: Networks, folder: Path, incarnation_id: str) -> Membership:
    hosts = folder / f"hosts-{incarnation_id}"
    hosts.touch()
    return networks.enroll(EndpointId("user", incarnation_id), "group", "", incarnation_id, hosts)


def interfaces(pid: int) -> set[str]:
    text = subprocess.run(
        ["nsenter", f"--net=/proc/{pid}/ns/net", "ip", "-brief", "link"],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    return {line.split("@")[0].split()[0] for line in text.splitlines()}


async def test_a_cancelled_first_member_leaves_a_switch(
    networks: Networks, members: list[int], tmp_path: Path
) -> None:
    """The first member's connection is cancelled just after it began; the next member is connected."""
    membership = enroll(networks, tmp_path, "m1")
    enroll(networks, tmp_path, "m2")
    first = asyncio.create_task(networks.attach("m1", members[0]))
    await asyncio.sleep(0)
    first.cancel()
    await asyncio.wait([first])
    assert first.cancelled()
    while True:
        with contextlib.suppress(NetworkError):
            await asyncio.to_thread(configure, membership.switch, ["link show bridge"])
            break
    await networks.attach("m2", members[1])
    assert "eth0" in interfaces(members[1])
    await networks.detach("m1")
    await networks.detach("m2")


async def test_a_member_that_fails_leaves_a_switch(
    networks: Networks, members: list[int], tmp_path: Path
) -> None:
    """The first member cannot be connected after the switch was made; the next one is connected."""
    inside = open_namespace(members[0])
    configure(inside, ["link add name eth0 type veth peer name other"])
    os.close(inside)
    enroll(networks, tmp_path, "m1")
    with pytest.raises(NetworkError, match="File exists"):
        await networks.attach("m1", members[0])
    enroll(networks, tmp_path, "m2")
    await networks.attach("m2", members[1])
    assert "eth0" in interfaces(members[1])
    await networks.detach("m1")
    await networks.detach("m2")
