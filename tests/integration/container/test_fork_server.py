"""What happens to containers and their starts when a process of their machinery dies."""

from __future__ import annotations

import asyncio
import os
import resource
import shutil
import signal
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from support.container_specs import ECHO
from support.containers import Machine, program_of, until

from rce.control.model import EndpointState, NodeState
from rce.model.specs import NodeSpec
from rce_container.environment import proc
from rce_container.incarnation import Incarnation
from rce_container.runtimes.held import HeldHandle
from rce_container.runtimes.namespace import NamespaceRuntime

BOX = "user/box"
TALK = NodeSpec(tag="node", pkg="own", exe="talk.py")

pytestmark = pytest.mark.needs("bwrap")


@pytest.fixture
async def namespaces(folder: Path) -> AsyncIterator[Machine]:
    machine = Machine(folder, "namespace")
    yield machine
    machine.tidy()


@pytest.fixture
def many_descriptors() -> Iterator[None]:
    """More open descriptors than select() can wait for."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = 4096
    if hard < needed:
        pytest.skip(f"a process may open only {hard} files here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, needed), hard))
    fds = [os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC) for _ in range(1100)]
    yield
    for fd in fds:
        os.close(fd)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def fork_server(machine: Machine) -> int:
    assert isinstance(machine.runtime, NamespaceRuntime)
    return machine.runtime._fork_server.pid


async def running(machine: Machine, id_: str = BOX, nodes: tuple[NodeSpec, ...] = ()) -> None:
    await machine.put(id_, nodes=nodes)
    await until(lambda: (s := machine.status(id_)) is not None and s.state is EndpointState.RUNNING)


@pytest.mark.parametrize("victim", ["holder", "bubblewrap", "shim", "environment"])
async def test_a_container_that_lost_a_part_is_made_again(namespaces: Machine, victim: str) -> None:
    machine = namespaces
    async with machine.engine():
        await running(machine, nodes=(ECHO,))
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        first = machine.reported(BOX)
        (incarnation,) = machine.manager._incarnations.values()
        handle = incarnation.handle
        assert isinstance(handle, HeldHandle)
        assert handle.environment is not None
        machine.note_processes()
        holder = proc.read(handle.namespaces_pid)
        assert holder is not None
        pids = {
            "holder": holder.pid,
            "bubblewrap": holder.parent,
            "shim": handle.process.pid,
            "environment": handle.environment.pid,
        }
        assert len(set(pids.values())) == 4
        os.kill(pids[victim], signal.SIGKILL)
        await until(lambda: machine.reported(BOX).incarnation not in ("", first.incarnation))
        assert [pid for pid, start in machine.pids.items() if proc.alive(pid, start)] == []
        await machine.node_is(BOX, "echo", NodeState.RUNNING)


@pytest.mark.usefixtures("many_descriptors")
async def test_a_container_starts_beside_many_descriptors(namespaces: Machine) -> None:
    async with namespaces.engine():
        await running(namespaces)
        assert namespaces.faults == []


@pytest.mark.needs("root")
async def test_environments_inherit_the_search_for_packages(namespaces: Machine) -> None:
    """A folder that only the engine may list has a package: a container knows of it by what was found."""
    machine = namespaces
    closed = machine.packages / "closed"
    shutil.copytree(machine.packages / "own", closed / "deep")
    (closed / "deep" / "package.yaml").write_text("name: deep\n")
    closed.chmod(0o711)
    async with machine.engine():
        await running(machine, "user/other")
        await running(machine, nodes=(NodeSpec(tag="deep", pkg="deep", exe="talk.py"),))
        await machine.log_holds(BOX, "deep", "hello")
        assert machine.faults == []


async def test_containers_do_not_need_the_fork_server(namespaces: Machine) -> None:
    machine = namespaces
    async with machine.engine():
        await running(machine, nodes=(TALK,))
        before = machine.reported(BOX)
        old = fork_server(machine)
        os.kill(old, signal.SIGKILL)
        await running(machine, "user/other")
        assert fork_server(machine) not in (0, old)
        assert machine.reported(BOX).incarnation == before.incarnation
        await machine.put(BOX, 2, nodes=(TALK, ECHO))
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        assert machine.faults == []


async def test_a_start_survives_the_fork_server(namespaces: Machine) -> None:
    machine = namespaces
    async with machine.engine():
        old = fork_server(machine)
        os.kill(old, signal.SIGSTOP)
        await machine.put(BOX)
        await until(lambda: _waits_for_request(machine), what="the fork server has got its order")
        os.kill(old, signal.SIGKILL)
        await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING)
        assert machine.faults == []
        assert len(machine.marks | {path.name for path in machine.containers}) == 1


def _waits_for_request(machine: Machine) -> bool:
    return any(
        incarnation.handle.namespaces_pid and not incarnation.handle.environment
        for incarnation in _incarnations(machine)
    )


def _incarnations(machine: Machine) -> list[Incarnation]:
    return list(machine.manager._incarnations.values())


async def test_manager_that_dies_before_a_fork_leaves_nothing(namespaces: Machine) -> None:
    machine = namespaces
    async with machine.managed(grace=0.2):
        os.kill(fork_server(machine), signal.SIGSTOP)
        await machine.put(BOX)
        await until(lambda: _waits_for_request(machine), what="the fork server has got its order")
        machine.note_processes()
    os.kill(fork_server(machine), signal.SIGKILL)
    await until(lambda: not machine.left(), what=machine.left)


async def test_a_node_starts_without_the_node_fork_server(namespaces: Machine) -> None:
    machine = namespaces
    async with machine.engine():
        await running(machine)
        (node_server,) = [one for one in machine.processes() if program_of(one.pid) == "rce-node-server"]
        os.kill(node_server.pid, signal.SIGKILL)
        await until(lambda: not proc.alive(node_server.pid, node_server.start))
        await machine.put(BOX, 2, nodes=(TALK, ECHO))
        assert "hello" in await machine.log_holds(BOX, "node", "hello")
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        assert machine.faults == []


async def test_the_fork_server_ends_with_its_manager(namespaces: Machine) -> None:
    pid = fork_server(namespaces)
    process = proc.read(pid)
    assert process is not None
    assert isinstance(namespaces.runtime, NamespaceRuntime)
    orders = namespaces.runtime._fork_server._orders
    assert orders is not None
    orders.close()
    await until(lambda: not proc.alive(pid, process.start), what="the fork server has ended")


async def test_nobody_waits_for_bubblewrap_that_fails(namespaces: Machine) -> None:
    machine = namespaces
    async with machine.engine():
        assert isinstance(machine.runtime, NamespaceRuntime)
        machine.runtime._bwrap = "/bin/false"
        await machine.put(BOX)
        await until(lambda: machine.faults, timeout=10)
        assert "its namespaces cannot be made" in machine.faults[0]
        machine.runtime._bwrap = "/usr/bin/bwrap"
        async with asyncio.timeout(60):
            await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING)
