"""What goes wrong around containers: each failure is told in words that help, and nothing is left of it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.container_specs import ECHO
from support.containers import Machine, until

from rce.control.model import EndpointState, NodeState
from rce.model.specs import NodeSpec, RestartPolicy
from rce_container.environment import proc
from rce_container.exceptions import StateError
from rce_container.folder import ContainerFolder, Record
from tools.leaks import footprint

BOX = "user/box"
MB = 1 << 20


def own(
    exe: str,
    args: str = "",
    tag: str = "node",
    restart: RestartPolicy = RestartPolicy.NEVER,
    max_restarts: int = 5,
) -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe=exe, args=args, restart=restart, max_restarts=max_restarts)


async def running(machine: Machine, id_: str = BOX) -> None:
    await until(
        lambda: (s := machine.status(id_)) is not None and s.state is EndpointState.RUNNING,
        what=lambda: f"{id_} is running: {machine.status(id_)}",
    )


async def fault(machine: Machine, *words: str) -> str:
    def found() -> str:
        return next((text for text in machine.faults if all(word in text for word in words)), "")

    return str(await until(found, what=lambda: f"a fault with {words} among {machine.faults}"))


# Packages

BROKEN = {
    "syntax.py": ("def broken(:\n", 0o755, "SyntaxError: "),
    "imports.py": ("import no_such_module\n", 0o755, "No module named 'no_such_module'"),
    "closed": ("#!/bin/sh\n", 0o644, "may not be executed (chmod +x makes it so)"),
    "stranger": ("#!/no/such/interpreter\n", 0o755, "/no/such/interpreter"),
    "text": ("this is not a program\n", 0o755, "its first line must name"),
}


async def test_each_broken_node_is_told_with_what_is_wrong_with_it(machine: Machine) -> None:
    folder = machine.packages / "own" / "nodes"
    for name, (text, mode, _) in BROKEN.items():
        (folder / name).write_text(text)
        (folder / name).chmod(mode)
    (machine.packages / "bad").mkdir()
    (machine.packages / "bad" / "package.yaml").write_text("name: [\n")
    nodes = [own(name, tag=name.partition(".")[0]) for name in BROKEN]
    async with machine.engine():
        await machine.put(BOX, nodes=(*nodes, NodeSpec(tag="bad", pkg="bad", exe="x.py"), ECHO))
        for node, (_, _, words) in zip(nodes, BROKEN.values(), strict=True):
            await fault(machine, f"node {node.tag}", words)
            assert (await machine.node_is(BOX, node.tag, NodeState.FAILED)).pid == 0
        await fault(machine, "node bad", "package.yaml")
        await machine.node_is(BOX, "echo", NodeState.RUNNING)


async def test_a_node_that_ends_at_once_is_not_started_for_ever(machine: Machine) -> None:
    async with machine.engine():
        node = own("end.py", restart=RestartPolicy.ALWAYS, max_restarts=2)
        await machine.put(BOX, nodes=(node, ECHO))
        text = await fault(machine, "node node")
        assert "2" in text, text
        failed = await machine.node_is(BOX, "node", NodeState.FAILED)
        assert failed.restarts == 2
        await machine.node_is(BOX, "echo", NodeState.RUNNING)


# Floods

FLOOD = """
import os, sys
line = b"x" * 99 + b"\\n"
piece, left = line * 10_000, int(sys.argv[1])
while left > 0:
    left -= os.write(1, piece)
print("flooded", flush=True)
import time
time.sleep(600)
"""


async def flooded(machine: Machine, tag: str) -> None:
    deadline = time.monotonic() + 40
    while "flooded" not in await machine.log(BOX, tag, -100):
        assert time.monotonic() < deadline, f"{tag} floods still"
        await asyncio.sleep(0.05)


async def test_a_flood_leaves_log_and_memory_as_they_were(machine: Machine) -> None:
    (machine.packages / "own" / "nodes" / "torrent.py").write_text(FLOOD)
    async with machine.engine():
        await machine.put(BOX, nodes=(own("torrent.py", str(2 * MB)), ECHO))
        await flooded(machine, "node")
        before = footprint(machine.environment().pid), footprint(os.getpid())
        floods = [own("torrent.py", str(12 * MB), tag=f"flood{number}") for number in range(2)]
        await machine.put(BOX, 2, nodes=(ECHO, *floods))
        for node in floods:
            await flooded(machine, node.tag)
        after = footprint(machine.environment().pid), footprint(os.getpid())
        for old, new in zip(before, after, strict=True):
            assert new.memory < old.memory + 16 * MB
        logs = machine.folder / "state/logs/user/box"
        assert sum(path.stat().st_size for path in logs.rglob("flood*")) < 2 * 3 * MB
        assert machine.faults == []


# Full disks


@pytest.fixture
def small_disk(folder: Path) -> Iterator[Path]:
    """A state directory on a disk of a megabyte."""
    disk = Path(tempfile.mkdtemp(prefix="rce-disk-", dir="/tmp"))
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], check=True)
    (folder / "state").symlink_to(disk)
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)
    disk.rmdir()


def fill(folder: Path) -> Path:
    """Take all that is left of a disk."""
    ballast = folder / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        for size in (4096, 1):
            while file.write(b"x" * size):
                pass
    return ballast


@pytest.mark.needs("root")
async def test_a_full_disk_is_told_and_nothing_else_is_lost(machine: Machine, small_disk: Path) -> None:
    async with machine.engine():
        await machine.put("user/first", nodes=(ECHO, own("talk.py")))
        await machine.node_is("user/first", "echo", NodeState.RUNNING)
        ballast = fill(small_disk)
        await machine.put(BOX, nodes=(ECHO,))
        text = await fault(machine, "container box", "cannot be started", os.strerror(errno.ENOSPC))
        assert f"{machine.folder}/state" in text, text
        assert len(machine.containers) == 1, "a container that cannot be started left its folder"
        assert {control_group.name for control_group in machine.control_groups()} <= {
            path.name for path in machine.containers
        }
        assert (await machine.node_is("user/first", "echo", NodeState.RUNNING)).restarts == 0
        ballast.unlink()
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        fill(small_disk)
        await machine.drop("user/first")
        assert machine.status("user/first") is None
    assert not list(small_disk.rglob("*.new"))


async def test_a_container_without_a_record_leaves_nothing(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its processes were started already, and it is tried again as long as the disk is full."""
    refused: list[Record] = []

    def refuse(folder: ContainerFolder, record: Record) -> None:
        refused.append(record)
        raise StateError(f"cannot write {folder.path}: {os.strerror(errno.ENOSPC)}")

    async with machine.engine():
        await machine.put("user/first", nodes=(ECHO,))
        await machine.node_is("user/first", "echo", NodeState.RUNNING)
        await machine.drop("user/first")
        before = footprint(os.getpid()).fds
        monkeypatch.setattr(ContainerFolder, "write_record", refuse)
        await machine.put(BOX, nodes=(ECHO,))
        await until(lambda: len(refused) >= 3, what="three attempts")
        await machine.drop(BOX)
        await until(lambda: footprint(os.getpid()).fds <= before, what="no file is left open")
        assert [one.pid for one in refused if proc.read(one.pid, zombies=True)] == []
