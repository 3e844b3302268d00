"""Goals that people give while the fleet manager is away: sent to a restarted planner until it is here."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from aiohttp.test_utils import TestClient, TestServer
from support.planner_states import robot, state

from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.planner_client import (
    FLEET_REQUEST,
    GET_STATE,
    SET_GOAL,
    PlannerClient,
    PlannerListener,
    PlannerUnavailableError,
)
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

EVENTS = {"events": [], "journal": "a", "newest": 0, "next": 0}


class Planner(PlannerClient):
    """Answers for the planner and the fleet manager."""

    def __init__(self) -> None:
        super().__init__("away")
        self.manager_is_here = True
        self.goals: list[tuple[str, int]] = []
        self.gates: dict[tuple[str, int], asyncio.Event] = {}
        """Goals that are answered only once the event is set."""
        self._calls |= {
            FLEET_REQUEST: self._ask_manager,
            SET_GOAL: self._set_goal,
            GET_STATE: self._get_state,
        }

    async def run(self, listener: PlannerListener, ready: Callable[[], Awaitable[None]]) -> None:
        del listener
        await ready()
        await asyncio.Event().wait()

    async def _ask_manager(self, request: dict[str, Any]) -> dict[str, Any]:
        if not self.manager_is_here:
            raise PlannerUnavailableError("the manager restarts")
        body = EVENTS if request["method"] == "GET" else {"message": "noted"}
        return {"status": 200, "body": json.dumps(body), "revision": ""}

    async def _set_goal(self, request: dict[str, Any]) -> dict[str, Any]:
        goal = request["robot"], request["cell"]
        self.goals.append(goal)
        if goal in self.gates:
            await self.gates[goal].wait()
        return {"ok": True, "message": "drives"}

    async def _get_state(self, request: dict[str, Any]) -> dict[str, Any]:
        raise PlannerUnavailableError("no state")


def of(started: str) -> dict[str, Any]:
    return state(robot("Robot1"), robot("Robot2"), started=started)


@asynccontextmanager
async def running() -> AsyncIterator[tuple[Planner, FleetLink, Station, TestClient[Any, Any]]]:
    planner, view = Planner(), FleetView()
    link = FleetLink(
        planner, view, on_change=lambda _: None, on_pose=lambda _: None, on_event=lambda *_: None
    )
    link.take_state(of("1.0"))
    station = Station(view, link, Broadcast())

    async def ready() -> None: ...

    task = asyncio.create_task(link.run(ready))
    try:
        async with TestClient(TestServer(station.make_app())) as client:
            yield planner, link, station, client
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.slow
async def test_a_goal_is_the_managers_matter_once_it_is_back() -> None:
    async with running() as (planner, link, station, client):
        manager = station.fleet_api.manager
        await manager.look()
        planner.manager_is_here = False
        await manager.look()
        async with client.put("/api/v1/robots/Robot1/goal", json={"cell": 5}) as reply:
            assert reply.status == 200
        assert planner.goals == [("Robot1", 5)]
        planner.manager_is_here = True
        await manager.look()
        await link.set_goal("Robot2", 6)
        planner.goals.clear()
        link.take_state(of("2.0"))
        async with asyncio.timeout(60):
            while ("Robot2", 6) not in planner.goals:
                await asyncio.sleep(0.02)
        assert ("Robot1", 5) not in planner.goals


@pytest.mark.slow
async def test_a_goal_is_sent_again_while_the_manager_is_away() -> None:
    async with running() as (planner, link, station, client):
        await station.fleet_api.manager.look()
        planner.manager_is_here = False
        await station.fleet_api.manager.look()
        async with client.put("/api/v1/robots/Robot1/goal", json={"cell": 5}) as reply:
            assert reply.status == 200
        planner.goals.clear()
        link.take_state(of("2.0"))
        async with asyncio.timeout(60):
            while ("Robot1", 5) not in planner.goals:
                await asyncio.sleep(0.02)


async def until_sent(planner: Planner, robot_id: str, cell: int) -> None:
    async with asyncio.timeout(60):
        while (robot_id, cell) not in planner.goals:
            await asyncio.sleep(0.02)


@pytest.mark.slow
async def test_a_goal_cancelled_meanwhile_is_not_sent_again() -> None:
    """The resent goals of two robots are on their way: one is cancelled before its turn, one after it."""
    async with running() as (planner, link, _, _):
        for name, cell in (("Robot1", 5), ("Robot2", 6)):
            await link.set_goal(name, cell)
        planner.goals.clear()
        planner.gates["Robot1", 5] = asyncio.Event()
        link.take_state(of("2.0"))
        await until_sent(planner, "Robot1", 5)
        await link.set_goal("Robot1", None)
        await link.set_goal("Robot2", None)
        await link.set_goal("Robot2", 7)
        planner.goals.clear()
        planner.gates["Robot1", 5].set()
        await until_sent(planner, "Robot2", 7)  # in the next round
        assert {("Robot1", 5), ("Robot2", 6)}.isdisjoint(planner.goals)


@pytest.mark.slow
async def test_a_goal_is_not_sent_behind_its_cancellation() -> None:
    """The planner has not answered the cancellation when the goal's turn comes."""
    async with running() as (planner, link, _, _):
        for name, cell in (("Robot1", 5), ("Robot2", 6)):
            await link.set_goal(name, cell)
        planner.goals.clear()
        planner.gates = {("Robot1", 5): asyncio.Event(), ("Robot2", -1): asyncio.Event()}
        link.take_state(of("2.0"))
        await until_sent(planner, "Robot1", 5)
        cancelling = asyncio.create_task(link.set_goal("Robot2", None))
        await until_sent(planner, "Robot2", -1)
        planner.goals.clear()
        planner.gates["Robot1", 5].set()
        await until_sent(planner, "Robot1", 5)  # in the next round
        assert ("Robot2", 6) not in planner.goals
        planner.gates["Robot2", -1].set()
        await cancelling
