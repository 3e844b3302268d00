from __future__ import annotations

import asyncio

import pytest

from rce_master.exceptions import TooMuchError
from rce_master.quotas import ITEMS_PER_REQUEST, Quotas, QuotaSettings
from rce_master.state.user_records import User, UserRole

ANNA, BERT = (User(name=name, role=UserRole.USER, password="x", created=0.0) for name in ("anna", "bert"))
ADMIN = User(name="root", role=UserRole.ADMIN, password="x", created=0.0)
SMALL = QuotaSettings(requests=2, request_burst=10, streams=2, log_reads=1)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_requests_are_counted_for_each_user() -> None:
    clock = Clock()
    quotas = Quotas(SMALL, clock)
    for _ in range(10):
        quotas.request(ANNA)
    with pytest.raises(TooMuchError, match="you may make 2 a second; try again in 1 s") as refused:
        quotas.request(ANNA)
    assert refused.value.retry_after == 0.5
    quotas.request(BERT)
    quotas.robot_request(ANNA, 0)
    clock.now = 0.5
    quotas.request(ANNA)
    for _ in range(100):
        quotas.request(ADMIN)


def test_a_large_request_of_a_robot_costs_more() -> None:
    clock = Clock()
    quotas = Quotas(SMALL, clock)
    quotas.robot_request(ANNA, 100 * ITEMS_PER_REQUEST)
    with pytest.raises(TooMuchError, match="try again in 46 s"):
        quotas.robot_request(ANNA, 0)
    clock.now = 46.0
    quotas.robot_request(ANNA, 0)


def test_streams_are_counted_for_each_user() -> None:
    quotas = Quotas(SMALL)
    with quotas.stream(ANNA), quotas.stream(ANNA):
        with pytest.raises(TooMuchError, match="you follow 2 streams"), quotas.stream(ANNA):
            pass
        with quotas.stream(BERT):
            pass
    with quotas.stream(ANNA), quotas.stream(ADMIN), quotas.stream(ADMIN), quotas.stream(ADMIN):
        pass


async def test_replays_of_events_are_paced(monkeypatch: pytest.MonkeyPatch) -> None:
    """They wait, are counted by user, and leave the user's requests."""
    waited: list[float] = []

    async def sleep(seconds: float) -> None:
        waited.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    quotas = Quotas(SMALL, Clock())
    for _ in range(12):
        await quotas.replay(ANNA)
    await quotas.replay(BERT)
    assert waited == [0.0] * 10 + [0.5, 1.0, 0.0]
    for _ in range(100):
        await quotas.replay(ADMIN)
    assert len(waited) == 13
    for _ in range(10):
        quotas.request(ANNA)


async def test_reads_of_logs_wait_for_those_of_the_same_user_only() -> None:
    quotas = Quotas(SMALL)
    async with quotas.log_read(ANNA):
        second = asyncio.create_task(quotas.log_read(ANNA).__aenter__())
        await asyncio.sleep(0)
        async with quotas.log_read(BERT):
            assert not second.done()
    await second


def test_no_limit_is_none() -> None:
    quotas = Quotas(QuotaSettings(requests=0, streams=0))
    for _ in range(10_000):
        quotas.request(ANNA)
        quotas.robot_request(ANNA, 1000)
