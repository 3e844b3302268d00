"""What ``/healthz`` says of a store that does not answer."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from aiohttp.test_utils import make_mocked_request
from support.master_cloud import FragileStore

from rce_master.http import health
from rce_master.http.health import Health
from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings
from rce_master.state_service import StateService


class SilentStore(FragileStore):
    """Answers no check until it is told to.

    Attributes:
        checks: How often it was asked.
    """

    def __init__(self) -> None:
        super().__init__()
        self.checks = 0
        self.answers = asyncio.Event()

    async def check(self) -> None:
        self.checks += 1
        await self.answers.wait()


async def ask(served: Health) -> tuple[int, dict[str, Any]]:
    async with asyncio.timeout(60):
        answer = await served.handle(make_mocked_request("GET", "/healthz"))
    assert isinstance(answer.body, bytes)
    return answer.status, json.loads(answer.body)


async def test_a_silent_store_delays_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "CHECK_S", 0.05)
    store = SilentStore()
    served = Health(await StateService.open(store))
    for _ in range(2):
        status, body = await ask(served)
        assert (status, body["status"]) == (503, "the store has not answered within 0.05 s")
    assert store.checks == 1
    store.answers.set()
    monkeypatch.setattr(health, "CHECK_S", 60.0)
    assert (await ask(served))[0] == 200


async def test_a_fenced_master_asks_no_store() -> None:
    core = LeadershipCore(LeaseSettings(ttl=3.0))
    core.granted(100.0, 3.0)
    core.elected(0, 100.0)
    store = SilentStore()
    fence = Fence(core, lambda: 103.0, "one:9000")
    status, body = await ask(Health(await StateService.open(store), fence))
    assert (status, body["role"], store.checks) == (503, "standby", 0)


async def test_warnings_stand_beside_a_status_that_is_good() -> None:
    texts = ["", "the disk is full", "join a third"]
    warnings = [lambda number=number: texts[number] for number in range(3)]
    served = Health(await StateService.open(FragileStore()), warnings=warnings)
    status, body = await ask(served)
    assert (status, body["status"]) == (200, "ok; the disk is full; join a third")
    texts[:] = ["", "", ""]
    assert (await ask(served))[1]["status"] == "ok"
