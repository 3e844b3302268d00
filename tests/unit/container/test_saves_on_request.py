"""Saves of many nodes at once, as at the end of a machine; the test is the environment and the master."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from rce.aio.tasks import BackgroundTasks
from rce.control import NODE_STATES, NodeStateError
from rce.control.node_states import Keep
from rce_container import node_states
from rce_container.environment import messages as m
from rce_container.node_states import ContainerStates, StateCarrier, save_all

NODES = [f"n{number}" for number in range(600)]


class Master:
    """Keeps states, each after some turns of the event loop."""

    def __init__(self) -> None:
        self.kept: set[str] = set()

    async def keep(self, question: Keep, state: bytes) -> None:
        await asyncio.sleep(0)
        self.kept.add(question.node)


class Environment:
    """Saves its nodes' states on request, all at once."""

    def __init__(self, carrier: StateCarrier) -> None:
        self.states = ContainerStates("anna/c", "one", carrier)
        self.is_deaf = False
        self.ended: list[str] = []
        self._carrier = carrier
        self._tasks = BackgroundTasks()

    def send(self, line: bytes) -> None:
        order = m.decode_to_environment(line)
        assert isinstance(order, m.SaveState)
        if not self.is_deaf:
            self._tasks.spawn(self._save(order), name=order.node)

    async def _save(self, order: m.SaveState) -> None:
        offered = m.StateOffered(request=order.request, node=order.node, size=1)
        error = ""
        try:
            await self._carrier.keep(self._carrier.question("anna/c", "one", offered, b"1"), b"1")
        except NodeStateError as failure:
            error = str(failure)
        self.states.handle(cast("Any", self), m.StateSaved(request=order.request, error=error))

    async def save_states(self) -> None:
        channel = cast("Any", self)
        self.ended += await asyncio.gather(*(self.states.save(channel, node) for node in NODES))

    async def close(self) -> None:
        await self.states.close()
        await self._tasks.close()


@pytest.fixture
def master() -> Master:
    return Master()


@pytest.fixture
def environment(master: Master) -> Environment:
    carrier = StateCarrier("c1", cast("Any", master))
    carrier.learn({NODE_STATES})
    return Environment(carrier)


async def test_many_states_that_are_saved_at_once_are_all_kept(
    environment: Environment, master: Master
) -> None:
    await save_all([environment])
    assert environment.ended == [""] * len(NODES)
    assert master.kept == set(NODES)
    await environment.close()


async def test_saves_that_wait_end_with_their_container(environment: Environment, master: Master) -> None:
    environment.is_deaf = True
    saving = asyncio.create_task(environment.save_states())
    await asyncio.sleep(0)
    await environment.close()
    async with asyncio.timeout(30):
        await saving
    assert environment.ended == ["its container ended"] * len(NODES)


async def test_nodes_that_hang_delay_the_end_by_a_limited_time(
    environment: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_states, "_ALL_S", 0.01)
    environment.is_deaf = True
    async with asyncio.timeout(10):
        await save_all([environment])
    assert environment.ended == []
    await environment.close()
