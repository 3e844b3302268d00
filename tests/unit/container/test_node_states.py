"""Saving and restoring of nodes, with a graph and a vault in the test's hand."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from msgspec.structs import replace

from rce.aio.tasks import cancel_and_wait
from rce.model import MAX_STATE, NodeSpec, StateServices
from rce_container.environment.exceptions import NodeStateError
from rce_container.environment.graph import GraphError
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes import states
from rce_container.environment.nodes.states import NodeStates

NODE = NodeSpec(
    tag="n",
    pkg="p",
    exe="x",
    namespace="/ns",
    name="counter",
    state_services=StateServices(save="save", restore="~restore", every=86400.0),
)
OFTEN = replace(NODE, state_services=StateServices(save="save", restore="~restore", every=0.01))


class FakeGraph:
    """A node that has a state, or fails."""

    def __init__(self) -> None:
        self.state = b"fresh"
        self.next_states: list[bytes] = []
        """Those that it has at the next saves."""
        self.fault = ""
        self.calls: list[str] = []

    def _check(self, service: str) -> None:
        self.calls.append(service)
        if self.fault:
            raise GraphError(self.fault)

    async def wait_for_service(self, service: str, timeout: float) -> None:
        self._check(f"wait {service}")

    async def save_state(self, service: str, timeout: float) -> bytes:
        self._check(f"save {service}")
        if self.next_states:
            self.state = self.next_states.pop(0)
        return self.state

    async def restore_state(self, service: str, state: bytes, timeout: float) -> None:
        self._check(f"restore {service}")
        self.state = state

    def saves(self) -> int:
        return self.calls.count("save /ns/save")


class FakeVault:
    """Keeps states in memory, or fails."""

    def __init__(self, state: bytes | None = None) -> None:
        self.state = state
        self.faults: list[str] = []
        self.unanswered: set[bytes] = set()
        """Those that it keeps without an acknowledgement."""
        self.kept: list[bytes] = []

    async def fetch(self, node: str) -> bytes | None:
        if self.faults:
            raise NodeStateError(self.faults.pop())
        return self.state

    async def keep(self, node: str, state: bytes) -> None:
        if self.faults:
            raise NodeStateError(self.faults.pop())
        self.kept.append(state)
        if state in self.unanswered:
            raise NodeStateError("the container's manager went away")


class Run:
    """A life of the node."""

    def __init__(self, graph: FakeGraph, vault: FakeVault) -> None:
        self.graph, self.vault = graph, vault
        self.states = NodeStates(graph, vault)  # type: ignore[arg-type]  # of a graph only what it needs
        self.events: list[e.Event] = []

    @property
    def restored(self) -> e.Restored | None:
        return next((one for one in self.events if isinstance(one, e.Restored)), None)

    @property
    def faults(self) -> list[str]:
        return [one.text for one in self.events if isinstance(one, e.Unsaved)]


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(30):
        while not condition():
            await asyncio.sleep(0.01)


@asynccontextmanager
async def running(graph: FakeGraph, vault: FakeVault, node: NodeSpec = NODE) -> AsyncIterator[Run]:
    run = Run(graph, vault)
    task = asyncio.create_task(run.states.keep(node, 7, run.events.append))
    try:
        await until(lambda: run.restored is not None)
        yield run
    finally:
        await cancel_and_wait(task)


async def test_a_node_gets_its_state_before_it_is_saved() -> None:
    async with running(FakeGraph(), FakeVault(b"41")) as run:
        assert run.restored == e.Restored("n", 7, "")
        assert run.graph.calls[:2] == ["wait /ns/counter/restore", "restore /ns/counter/restore"]
        assert await run.states.save_now("n") == ""
        assert run.graph.calls[2:] == ["wait /ns/save", "save /ns/save"]
        assert run.vault.kept == [b"41"]


async def test_a_node_without_a_saved_state_starts_without() -> None:
    async with running(FakeGraph(), FakeVault()) as run:
        assert run.graph.calls == ["wait /ns/save"]
        assert await run.states.save_now("n") == ""
        assert run.vault.kept == [b"fresh"]


async def test_a_node_that_was_not_restored_is_not_saved() -> None:
    graph = FakeGraph()
    graph.fault = "it is rotten"
    async with running(graph, FakeVault(b"41")) as run:
        assert run.restored == e.Restored("n", 7, "it is rotten")
        graph.fault = ""
        assert "was not restored" in await run.states.save_now("n")
        assert run.vault.kept == []


async def test_fetching_is_tried_again_until_it_is_known() -> None:
    vault = FakeVault(b"41")
    vault.faults = ["no master is connected"]
    async with running(FakeGraph(), vault) as run:
        assert run.faults == ["its state is not there yet: no master is connected; it is tried again"]
        assert run.graph.state == b"41"


async def test_equal_states_are_kept_once() -> None:
    graph = FakeGraph()
    graph.next_states = [b"1", b"1", b"2", b"1"]
    async with running(graph, FakeVault(), OFTEN) as run:
        await until(lambda: graph.saves() > 5)
        assert run.vault.kept == [b"1", b"2", b"1"]


async def test_equal_state_is_kept_again_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """The master may have lost it: a backup was restored, or it was removed on request."""
    monkeypatch.setattr(states, "REPEAT_S", 0.0)
    async with running(FakeGraph(), FakeVault(), OFTEN) as run:
        await until(lambda: len(run.vault.kept) > 1)


async def test_equal_state_is_kept_again_on_request() -> None:
    """What saves it for a move relies on it."""
    async with running(FakeGraph(), FakeVault()) as run:
        for _ in range(2):
            assert await run.states.save_now("n") == ""
        assert run.vault.kept == [b"fresh", b"fresh"]


async def test_state_before_an_unknown_outcome_is_kept_again() -> None:
    """The node returned to it, and the vault has the one in between."""
    graph, vault = FakeGraph(), FakeVault()
    graph.next_states = [b"A", b"B", b"A"]
    vault.unanswered = {b"B"}
    async with running(graph, vault, OFTEN):
        await until(lambda: graph.saves() > 3)
        assert vault.kept == [b"A", b"B", b"A"]


async def test_an_outage_of_the_vault_is_told_if_it_lasts() -> None:
    async with running(FakeGraph(), FakeVault()) as run:
        run.vault.faults = ["no master is connected"]
        assert "no master" in await run.states.save_now("n")
        assert await run.states.save_now("n") == ""
        assert run.faults == [""]


@pytest.mark.parametrize("fault", ["node", "vault"])
async def test_a_fault_is_told_and_the_next_save_repeats(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(states, "TOLD_AFTER_S", 0.0)
    async with running(FakeGraph(), FakeVault()) as run:
        if fault == "node":
            run.graph.fault = "it hangs"
        else:
            run.vault.faults = ["it hangs"]
        assert await run.states.save_now("n") == "its state is not saved: it hangs"
        run.graph.fault = ""
        assert await run.states.save_now("n") == ""
        assert run.faults == ["its state is not saved: it hangs", ""]
        assert run.vault.kept == [b"fresh"]


async def test_a_state_that_is_too_large_is_not_kept() -> None:
    async with running(FakeGraph(), FakeVault()) as run:
        run.graph.state = bytes(MAX_STATE)
        assert await run.states.save_now("n") == ""
        run.graph.state = bytes(MAX_STATE + 1)
        assert "larger than 16 MB" in await run.states.save_now("n")
        assert len(run.vault.kept) == 1


async def test_a_life_that_ended_is_not_saved() -> None:
    async with running(FakeGraph(), FakeVault()) as run:
        pass
    assert "does not run" in await run.states.save_now("n")


async def test_nodes_without_services_are_left_alone() -> None:
    states = NodeStates(FakeGraph(), FakeVault())  # type: ignore[arg-type]  # as above
    events: list[e.Event] = []
    await states.keep(NodeSpec(tag="n", pkg="p", exe="x"), 1, events.append)
    assert events == []
