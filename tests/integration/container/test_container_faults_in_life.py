"""Kill -9 of every part of a container at every step of its life, each held still until the kill."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.containers import Machine, program_of, until

from rce.control.messages import Drop
from rce.control.model import EndpointState, NodeState
from rce.model.specs import NodeSpec, Resources
from rce_container.environment import proc
from rce_container.folder import ContainerFolder
from rce_container.incarnation import Incarnation
from rce_container.runtimes.namespace import NamespaceRuntime

BOX = "user/box"
MB = 1 << 20
STUBBORN = NodeSpec(tag="node", pkg="own", exe="stubborn.py")

pytestmark = pytest.mark.needs("bwrap")


class Stage:
    """A machine whose container is held still at a step of its life."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        assert isinstance(machine.runtime, NamespaceRuntime)
        self.runtime = machine.runtime
        self._bwrap = self.runtime._bwrap
        self._stopped: list[int] = []

    @property
    def incarnation(self) -> Incarnation:
        (incarnation,) = self.machine.manager._incarnations.values()
        return incarnation

    async def reach(self, step: str) -> None:
        """Let the container come to a step, and hold it there."""
        machine = self.machine
        match step:
            case "spawned":
                self._hold_bubblewrap()
                await machine.put(BOX)
                await until(
                    lambda: self._children(self.incarnation.handle.process.pid), what="bubblewrap is held"
                )
            case "held":
                self._stop(self.runtime._fork_server.pid)
                await machine.put(BOX)
                await until(lambda: self.incarnation.handle.namespaces_pid, what="the holder is there")
            case "born":
                await machine.put(BOX)
                environment = await until(lambda: self.incarnation.handle.environment, what="its start")
                self._stop(environment.pid)
            case "running" | "resizing":
                await machine.put(BOX, nodes=(STUBBORN,))
                await machine.log_holds(BOX, "node", "ready")
                await until(lambda: (node := machine.node(BOX, "node")) is not None and node.pid)
                if step == "resizing":
                    await machine.put(BOX, 2, nodes=(STUBBORN,), resources=Resources(memory=200 * MB))
            case "stopping":
                await self.reach("running")
                await machine.manager.handle(Drop(id=BOX, revision=9))
                await until(lambda: machine.reported(BOX).state is EndpointState.STOPPING)
                await machine.log_holds(BOX, "node", "no ")
            case _:
                raise ValueError(step)
        machine.note_processes()

    def pid_of(self, part: str) -> int:
        handle = self.incarnation.handle
        shim = handle.process.pid
        environment = handle.environment.pid if handle.environment is not None else 0
        node_servers = (pid for pid in self._children(environment) if program_of(pid) == "rce-node-server")
        node = self.machine.node(BOX, "node")
        pids = {
            "shim": shim,
            "bubblewrap": next(iter(self._children(shim)), 0),
            "holder": handle.namespaces_pid,
            "fork server": self.runtime._fork_server.pid,
            "environment": environment,
            "node fork server": next(node_servers, 0),
            "node": node.pid if node is not None else 0,
        }
        assert pids[part], f"there is no {part}"
        return int(pids[part])

    def go_on(self) -> None:
        """Hold nothing any more."""
        self.runtime._bwrap = self._bwrap
        for pid in self._stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def _hold_bubblewrap(self) -> None:
        script = self.machine.folder / "held"
        script.write_text("#!/bin/sh\nexec setpriv --pdeathsig KILL sleep 600\n")
        script.chmod(0o755)
        self.runtime._bwrap = str(script)

    def _stop(self, pid: int) -> None:
        os.kill(pid, signal.SIGSTOP)
        self._stopped.append(pid)

    def _children(self, pid: int) -> list[int]:
        return [one.pid for one in proc.table().values() if one.parent == pid]


@pytest.fixture
async def stage(folder: Path) -> AsyncIterator[Stage]:
    machine = Machine(folder, "namespace")
    found = Stage(machine)
    yield found
    found.go_on()
    machine.tidy()


KILLS = [
    *(("spawned", part) for part in ("shim", "bubblewrap")),
    *(("held", part) for part in ("shim", "bubblewrap", "holder", "fork server")),
    *(("born", part) for part in ("shim", "holder", "environment")),
    *(("resizing", part) for part in ("bubblewrap", "environment")),
]


@pytest.mark.parametrize(("step", "part"), KILLS)
async def test_what_is_wanted_comes_to_life_again(stage: Stage, step: str, part: str) -> None:
    machine = stage.machine
    async with machine.engine(interrupt_timeout=0.2, terminate_timeout=0.2):
        await stage.reach(step)
        incarnation_id = stage.incarnation.incarnation_id
        old = dict(machine.pids)
        os.kill(stage.pid_of(part), signal.SIGKILL)
        stage.go_on()
        if part != "fork server":
            await until(
                lambda: machine.reported(BOX).incarnation not in ("", incarnation_id),
                what="another incarnation",
            )
            assert [pid for pid, start in old.items() if proc.alive(pid, start)] == []
            assert not [path for path in machine.containers if path.name == incarnation_id]
        await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING)
        assert len(machine.containers) == 1


@pytest.mark.parametrize("part", ["shim", "holder", "environment", "node fork server", "node"])
async def test_what_is_not_wanted_any_more_is_gone(
    stage: Stage, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = stage.machine
    monkeypatch.setattr("rce_container.incarnation._SHIM_TIMEOUT_S", 0.5)
    async with machine.engine(interrupt_timeout=1.0, terminate_timeout=0.2):
        await stage.reach("stopping")
        os.kill(stage.pid_of(part), signal.SIGKILL)
        await machine.drop(BOX)
        machine.check_clean()
        assert machine.faults == []


@pytest.mark.parametrize("step", ["spawned", "held", "born", "resizing", "stopping"])
async def test_a_manager_may_die_at_any_step(stage: Stage, step: str) -> None:
    machine = stage.machine
    async with machine.managed(grace=0.5, interrupt_timeout=0.2, terminate_timeout=0.2):
        await stage.reach(step)
    stage.go_on()
    async with machine.engine(interrupt_timeout=0.2, terminate_timeout=0.2):
        await machine.put(BOX)
        await until(lambda: (s := machine.status(BOX)) is not None and s.state is EndpointState.RUNNING)
        await until(lambda: len(machine.containers) == 1, what=lambda: machine.containers)


async def test_a_manager_may_die_while_it_cleans(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = stage.machine
    half = asyncio.Event()
    loop = asyncio.get_running_loop()

    def remove_half(folder: ContainerFolder) -> None:
        shutil.rmtree(folder.run)
        loop.call_soon_threadsafe(half.set)

    async with machine.managed():
        await stage.reach("running")
        with monkeypatch.context() as patch:
            patch.setattr(ContainerFolder, "remove", remove_half)
            os.kill(stage.pid_of("shim"), signal.SIGKILL)
            await half.wait()
    assert machine.containers
    async with machine.engine():
        await until(lambda: not machine.containers, what=lambda: machine.containers)


async def test_nodes_and_fork_server_may_die_during_resize(stage: Stage) -> None:
    """Nodes and their fork server may die while a container is resized."""
    machine = stage.machine
    async with machine.engine(interrupt_timeout=0.2, terminate_timeout=0.2):
        await stage.reach("resizing")
        incarnation_id = stage.incarnation.incarnation_id
        server, node = stage.pid_of("node fork server"), stage.pid_of("node")
        os.kill(server, signal.SIGKILL)
        with contextlib.suppress(ProcessLookupError):  # it may have ended of what ended its server
            os.kill(node, signal.SIGKILL)
        await machine.node_is(BOX, "node", NodeState.FAILED)
        assert stage.incarnation.incarnation_id == incarnation_id
