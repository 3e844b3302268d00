"""Actions of a station's users, on their way to an audit log that cannot be reached all the time."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rce.aio.backoff import Backoff
from rce.aio.tasks import cancel_and_wait
from rce_fleet.station import action_queue
from rce_fleet.station.action_queue import ActionQueue, ActionRefusedError, EngineAwayError, QueuedAction
from rce_fleet.station.authentication import AuditedAction

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Engine:
    """Takes actions, after the errors of a test."""

    def __init__(self, *errors: Exception) -> None:
        self.errors = deque(errors)
        self.taken: list[str] = []

    async def send(self, queued: QueuedAction) -> None:
        if self.errors:
            raise self.errors.popleft()
        self.taken.append(queued.action.subject)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(action_queue, "PAUSES", Backoff(first=0.0, longest=0.0))


def action(subject: str) -> QueuedAction:
    return QueuedAction("token", "anna", AuditedAction("set_goal", subject, "cell 7", "192.0.2.7"))


@asynccontextmanager
async def running(queue: ActionQueue) -> AsyncIterator[None]:
    task = asyncio.create_task(queue.run())
    try:
        yield
    finally:
        await cancel_and_wait(task)


async def test_actions_wait_for_an_engine_that_is_away(caplog: pytest.LogCaptureFixture) -> None:
    engine = Engine(EngineAwayError("off"), EngineAwayError("off", 0.01))
    queue = ActionQueue(engine.send)
    for subject in ("R1", "R2", "R3"):
        queue.put(action(subject))
    async with running(queue):
        await queue.drain()
    assert engine.taken == ["R1", "R2", "R3"], "in their order, each once"
    assert len(caplog.records) == 1, "that it is away is told once"


async def test_an_action_that_is_refused_stops_no_other(caplog: pytest.LogCaptureFixture) -> None:
    engine = Engine(ActionRefusedError("422 Unprocessable"))
    queue = ActionQueue(engine.send)
    for subject in ("R1", "R2"):
        queue.put(action(subject))
    async with running(queue):
        await queue.drain()
    assert engine.taken == ["R2"]
    assert caplog.messages == ["not in the audit log: set_goal R1 by anna: 422 Unprocessable"]


async def test_what_finds_no_place_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(action_queue, "MAX_QUEUED", 2)
    queue = ActionQueue(Engine().send)
    for subject in ("R1", "R2", "R3"):
        queue.put(action(subject))
    assert caplog.messages == ["not in the audit log, too many wait for the engine: set_goal R3 by anna"]


async def test_what_waits_at_the_end_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(action_queue, "DRAIN_S", 0.05)
    engine = Engine(EngineAwayError("off", 3600.0))
    queue = ActionQueue(engine.send)
    queue.put(action("R1"))
    async with running(queue):
        await queue.drain()
    queue.drop()
    assert engine.taken == []
    assert caplog.messages[-1] == "not in the audit log, the station ends: set_goal R1 by anna"
