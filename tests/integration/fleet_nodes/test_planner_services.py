"""The manager's calls of a planner that does not answer, or cannot be asked."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.manager.goals import NO_ANSWER
from rce_fleet.nodes import fleet_manager
from rce_fleet.nodes.fleet_manager import PlannerServices
from rce_fleet.station import ros_planner_client
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.tasks.records import Zone


@pytest.fixture
async def manager(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Node]:
    """A node in a graph whose planner never answers."""
    monkeypatch.setattr(fleet_manager, "CALL_TIMEOUT_S", 0.2)
    monkeypatch.setattr(ros_planner_client, "CALL_TIMEOUT_S", 0.2)
    types, never = TypeRegistry(PackageIndex([])), asyncio.Event()

    async def wait(request: Message) -> dict[str, bool]:
        del request
        await never.wait()
        return {}

    async with (
        Core(port=0) as core,
        Node("planner", argv=[], master_uri=core.uri, types=types, signals=False) as planner,
        Node("manager", argv=[], master_uri=core.uri, types=types, signals=False) as node,
    ):
        await planner.advertise_service("/fleet/set_goal", "fleet/SetGoal", wait)
        await planner.advertise_service("/fleet/set_zones", "fleet/SetZones", wait)
        yield node


async def test_a_planner_that_never_answers_ends_no_step(manager: Node) -> None:
    missed: list[bool] = []
    refusal = await PlannerServices(manager, lambda: missed.append(True)).set_goal("Robot1", 5)
    assert refusal.startswith(NO_ANSWER)
    assert missed == [True]


async def test_a_station_does_not_wait_for_a_silent_planner(manager: Node) -> None:
    ask = ros_planner_client._caller(manager.service_client("/fleet/set_goal", "fleet/SetGoal"))
    with pytest.raises(PlannerUnavailableError, match="did not answer"):
        await ask({"robot": "Robot1", "cell": 5})


async def test_a_request_without_a_message_form_is_not_sent(manager: Node) -> None:
    """A journal of an earlier release can hold a zone whose numbers have no room in a message."""
    services = PlannerServices(manager)
    refusal = await services.set_zone("lift", Zone("lift", "limited", (1,), 3e9), 0.0)
    assert refusal.startswith(NO_ANSWER)
    assert (await services.set_goal("Robot1", 2**31)).startswith(NO_ANSWER)
