"""The requests of a robot that wait for the master."""

from __future__ import annotations

import json
import tracemalloc
from typing import TYPE_CHECKING, cast

import pytest

from rce.model import CreateContainer, FaultCode
from rce.model.requests import Request
from rce.protocol import ErrorReport
from rce.protocol.reading import decode
from rce_robot.doors.client.waiting_requests import WaitingRequests
from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from rce_robot.doors.base import Owner


class Robot:
    """The robot's side: carries out everything at once, and notes what it is told."""

    def __init__(self) -> None:
        self.asked: list[Request] = []
        self.reports: list[ErrorReport] = []
        self.growths = 0

    async def ask_master(self, request: Request) -> tuple[ErrorReport, ...]:
        self.asked.append(request)
        return ()

    def grew(self) -> None:
        self.growths += 1

    def queue(self, **settings: int) -> WaitingRequests:
        limits = SessionSettings(max_request_bytes=settings.get("max_request_bytes", 4 << 20))
        return WaitingRequests(cast("Owner", self), limits, self.reports.append)


def parameters(value: object, count: int = 1) -> bytes:
    items = [{"containerTag": "c", "name": f"p{number}", "value": value} for number in range(count)]
    return json.dumps({"type": "CN", "data": {"setParam": items}}).encode()


@pytest.mark.parametrize(
    "text",
    [parameters([1.5] * 15_000), parameters(0.5, 400), parameters(["ab"] * 10_000)],
    ids=["list", "parameters", "texts"],
)
async def test_memory_of_waiting_requests_is_counted(text: bytes) -> None:
    """They are kept parsed, which takes many times the memory of the text."""
    robot = Robot()
    requests = robot.queue()
    decode(text)  # what is loaded and cached is there now
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        requests.put(cast("Request", decode(text)), len(text))
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 0.75 * grown <= requests.bytes <= 3 * grown  # Python keeps some objects for reuse
    assert robot.growths == 1
    requests.close()
    await requests.carry_out()
    assert len(robot.asked) == 1
    assert requests.bytes == 0


async def test_waiting_requests_are_bounded_by_their_text() -> None:
    """Room is there again when they were carried out."""
    robot = Robot()
    requests = robot.queue(max_request_bytes=2500)
    for number in range(4):
        requests.put(CreateContainer(tag=f"c{number}"), 1000)
    assert [report.code for report in robot.reports] == [FaultCode.BUSY] * 2
    requests.close()
    await requests.carry_out()
    requests.put(CreateContainer(tag="later"), 1000)
    assert len(robot.reports) == 2
