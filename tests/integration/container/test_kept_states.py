"""Nodes whose state is kept, in real containers; the test is the master that keeps it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.containers import Machine, until

from rce.control import NODE_STATES, NodeStateError
from rce.control.messages import SaveState, StateSaved, Welcome
from rce.control.model import EndpointState, NodeState
from rce.control.node_states import Fetch, Keep
from rce.model import NodeSpec, StateServices
from rce_container.manager import Manager

BOX = "user/box"
SERVICES = StateServices(save="save_count", restore="restore_count", every=1.0)
RARELY = StateServices(save="save_count", restore="restore_count", every=86400.0)
OURS = ("Test", "counter.py")
ROSPY = pytest.param(("rospy_nodes", "counter.py"), marks=pytest.mark.needs("rospy"))


class Keeper:
    """Keeps states in memory as the master does."""

    def __init__(self, **states: bytes) -> None:
        self.states = states
        self.questions: list[Keep] = []
        self.open = asyncio.Event()
        self.open.set()
        self.fault = ""

    async def fetch(self, question: Fetch, most: int) -> bytes | None:
        await self.open.wait()
        if self.fault:
            raise NodeStateError(self.fault)
        return self.states.get(question.node)

    async def keep(self, question: Keep, state: bytes) -> None:
        if self.fault:
            raise NodeStateError(self.fault)
        assert len(state) == question.size
        self.questions.append(question)
        self.states[question.node] = state

    def count(self, node: str = "count") -> int:
        return int(self.states.get(node, b"0"))

    async def passes(self, number: int) -> int:
        """Wait until a count is kept that is greater than a number."""
        await until(lambda: self.count() > number, what=f"a count over {number}")
        return self.count()


def counter(
    services: StateServices = SERVICES, program: tuple[str, str] = OURS, tag: str = "count"
) -> NodeSpec:
    return NodeSpec(tag=tag, pkg=program[0], exe=program[1], state_services=services)


def own(tag: str, exe: str, services: StateServices = SERVICES) -> NodeSpec:
    """A node in a namespace of its own: several have services of the same names."""
    return NodeSpec(tag=tag, pkg="own", exe=exe, namespace=tag, state_services=services)


@contextlib.asynccontextmanager
async def kept(machine: Machine, keeper: Keeper) -> AsyncIterator[Manager]:
    """Run a manager that is connected to a master."""
    machine.node_states = keeper  # type: ignore[assignment]  # as the client of a master
    async with machine.engine() as manager:
        await manager.handle(Welcome(version=2, master="test", features=(NODE_STATES,)))
        yield manager


async def kill_environment(machine: Machine) -> None:
    """Kill the environment; the node ends with it, and the container is made again."""
    pid = await machine.node_pid(BOX, "count")
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    environment = next(int(line.split()[1]) for line in status if line.startswith("PPid:"))
    before = machine.reported(BOX).incarnation
    os.kill(environment, signal.SIGKILL)
    with contextlib.suppress(ProcessLookupError):  # in a sandbox it has ended with the environment
        os.kill(pid, signal.SIGKILL)
    await until(lambda: machine.reported(BOX).incarnation not in ("", before), what="another incarnation")


async def detail_of(machine: Machine, node: str, text: str) -> str:
    def found() -> str:
        status = machine.node(BOX, node)
        return status.detail if status is not None and text in status.detail else ""

    return await until(found, timeout=120, what=f"{node} says {text!r}")


@pytest.mark.parametrize("program", [OURS, ROSPY], ids=lambda program: program[0])
async def test_a_count_outlives_its_container(machine: Machine, program: tuple[str, str]) -> None:
    keeper = Keeper(count=b"1000")
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(counter(program=program),))
        await machine.node_is(BOX, "count", NodeState.RUNNING)
        last = await keeper.passes(1000)
        keeper.states["count"] = b"2000"
        await kill_environment(machine)
        assert await keeper.passes(2000) < 2000 + last, "it counts on from what was kept"
    by_incarnation: dict[str, list[int]] = {}
    for question in keeper.questions:
        by_incarnation.setdefault(question.incarnation, []).append(question.number)
    assert len(by_incarnation) == 2
    assert all(numbers == sorted(set(numbers)) for numbers in by_incarnation.values()), "numbers grow"


async def test_a_node_is_up_once_it_is_restored(machine: Machine) -> None:
    keeper = Keeper(count=b"1000")
    keeper.open.clear()
    after = NodeSpec(tag="after", pkg="Test", exe="stringEcho.py", after=("count",))
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(counter(), after))
        await detail_of(machine, "count", "its state is restored")
        assert machine.reported_node(BOX, "count").state is NodeState.STARTING
        assert machine.reported_node(BOX, "after").state is NodeState.WAITING
        keeper.open.set()
        await machine.node_is(BOX, "after", NodeState.RUNNING)
        assert machine.reported_node(BOX, "count").state is NodeState.RUNNING


async def test_a_fetch_that_fails_is_repeated(machine: Machine) -> None:
    keeper = Keeper(count=b"1000")
    keeper.fault = "the master lacks it"
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(counter(),))
        text = await detail_of(machine, "count", "the master lacks it")
        assert "its state is not there yet" in text
        assert machine.reported_node(BOX, "count").state is NodeState.STARTING
        keeper.fault = ""
        await keeper.passes(1000)


async def test_a_failed_restore_keeps_the_snapshot(machine: Machine) -> None:
    keeper = Keeper(count=b"rotten")
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(counter(),))
        text = await detail_of(machine, "count", "was not restored")
        assert "'rotten' is not a count" in text
        assert machine.reported(BOX).state is EndpointState.DEGRADED
        request = SaveState(request=7, id=BOX, node="count")
        await machine.manager.handle(request)
        (answer,) = await until(lambda: machine.of(StateSaved), what="it is answered")
        assert (answer.request, "was not restored" in answer.error) == (7, True)
        assert keeper.states == {"count": b"rotten"}
        assert any("was not restored" in fault for fault in machine.faults)


async def test_a_state_is_saved_on_request_and_before_the_end(machine: Machine) -> None:
    """The node's state grows by one byte with each save."""
    keeper = Keeper(grow=b"restored ")

    async def answer(id_: str, node: str) -> StateSaved:
        machine.told.clear()
        await machine.manager.handle(SaveState(request=1, id=id_, node=node))
        (found,) = await until(lambda: machine.of(StateSaved), what="it is answered")
        return found

    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(own("grow", "grow.py", RARELY),))
        await machine.node_is(BOX, "grow", NodeState.RUNNING)
        for number in range(1, 4):
            assert await answer(BOX, "grow") == StateSaved(request=1)
            assert keeper.states["grow"] == b"restored " + b"x" * number
        assert "does not run" in (await answer(BOX, "other")).error
        assert "not running here" in (await answer("user/other", "grow")).error
    assert keeper.states["grow"] == b"restored xxxx", "the manager was told to end"


async def test_states_are_saved_before_a_container_ends_for_a_move(machine: Machine) -> None:
    """One with volumes ends before it starts elsewhere; one that is destroyed is not saved."""
    keeper = Keeper(grow=b"restored ")
    async with kept(machine, keeper):
        for elsewhere, state in ((True, b"restored x"), (False, b"restored x")):
            await machine.put(BOX, nodes=(own("grow", "grow.py", RARELY),))
            await machine.node_is(BOX, "grow", NodeState.RUNNING)
            await machine.drop(BOX, elsewhere=elsewhere)
            assert keeper.states["grow"] == state
            machine.told.clear()
        await machine.put(BOX, nodes=(own("grow", "grow.py", RARELY),))
        await machine.node_is(BOX, "grow", NodeState.RUNNING)
        keeper.fault = "the disk is full"
        await machine.drop(BOX, elsewhere=True)
        (fault,) = machine.faults
        assert "container box: the state of node grow is not saved at its end: " in fault
        assert "the disk is full" in fault


async def test_nodes_that_cannot_be_saved_harm_no_other(machine: Machine) -> None:
    keeper = Keeper(count=b"1000")
    nodes = (own("deaf", "deaf.py"), own("huge", "huge.py"), own("none", "talk.py"), counter())
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=nodes)
        assert "no answer" in await detail_of(machine, "deaf", "is not saved")
        assert "larger than 16 MB" in await detail_of(machine, "huge", "is not saved")
        await keeper.passes(keeper.count() + 5)
        assert machine.reported(BOX).state is EndpointState.RUNNING
        assert keeper.states.keys() == {"count"}
        assert len([fault for fault in machine.faults if "huge" in fault]) == 1, "it is told once"


async def test_a_large_state_is_carried_whole(machine: Machine) -> None:
    keeper = Keeper(large=bytes(range(256)) * (1 << 16))
    async with kept(machine, keeper):
        await machine.put(BOX, nodes=(own("large", "echo_state.py"),))
        await machine.node_is(BOX, "large", NodeState.RUNNING)
        (question,) = await until(lambda: keeper.questions, timeout=120, what="it is saved")
        assert question.size == 16 << 20
        assert keeper.states["large"] == bytes(range(256)) * (1 << 16)


async def test_without_a_master_that_keeps_states_nodes_start_without(machine: Machine) -> None:
    keeper = Keeper(count=b"1000")
    machine.node_states = keeper  # type: ignore[assignment]  # as the client of a master
    async with machine.engine() as manager:
        await manager.handle(Welcome(version=2, master="of an earlier release"))
        await machine.put(BOX, nodes=(counter(),))
        assert "of an earlier release" in await detail_of(machine, "count", "is not saved")
        assert machine.reported_node(BOX, "count").state is NodeState.RUNNING
