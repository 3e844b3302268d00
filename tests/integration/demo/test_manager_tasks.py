"""The demo's stream of tasks, with a real station, fleet manager and robots: nothing is lost unseen."""

from __future__ import annotations

import asyncio
from pathlib import Path
from random import Random

import aiohttp
import pytest
from support.fleet_station import fleet_station
from support.managed_fleet import LONGEST_S, ManagedFleet, managed_fleet

from rce_fleet.demo.manager_tasks import ManagerTasks
from rce_fleet.station.client import StationClient

pytestmark = pytest.mark.needs("pymunk")
CELLS = (0, 7, 27, 36, 56, 63)
OPEN = 3
"""Open tasks of two robots."""


async def follow(tasks: ManagerTasks, station: StationClient, done: int) -> set[str]:
    """Stream tasks until some are done; return the robots that were busy."""
    busy: set[str] = set()
    async with asyncio.timeout(LONGEST_S):
        while tasks.done < done or tasks.open < OPEN:
            await tasks.update(await station.fleet(), more=True)
            busy.update(tasks.busy)
            await asyncio.sleep(0.1)
    return busy


async def stream(fleet: ManagedFleet, url: str) -> None:
    async with aiohttp.ClientSession() as session:
        station = StationClient(session, url)
        async with ManagerTasks(url, CELLS, Random(2), robots=2) as tasks:
            assert await follow(tasks, station, 1) == {"Robot1", "Robot2"}
            await fleet.kill("fleet_manager.py")
            await tasks.update(await station.fleet(), more=True)
            await fleet.start("fleet_manager.py")
            await follow(tasks, station, tasks.done + 1)
            await tasks.settle()
            assert (tasks.accepted, tasks.lost, tasks.failed) == (tasks.done + tasks.open, [], [])
            assert tasks.open == OPEN


async def lose(fleet: ManagedFleet, url: str, journal: Path) -> None:
    async with aiohttp.ClientSession() as session, ManagerTasks(url, CELLS, Random(3), robots=2) as tasks:
        async with asyncio.timeout(LONGEST_S):
            while tasks.accepted < OPEN:
                await tasks.update(await StationClient(session, url).fleet(), more=True)
                await asyncio.sleep(0.1)
        await fleet.kill("fleet_manager.py")
        for file in journal.parent.glob(f"{journal.name}*"):
            file.unlink()
        await fleet.start("fleet_manager.py")
        await fleet.ask("GET", "/tasks")  # until it answers: on a busy machine that takes long
        await tasks.settle()
        assert (len(tasks.lost), tasks.failed) == (tasks.accepted, [])


async def test_tasks_survive_a_manager_with_its_journal(tmp_path: Path) -> None:
    """A manager that is killed loses nothing; one that lost its journal has lost the tasks."""
    journal = tmp_path / "journal.sqlite"
    async with managed_fleet(journal, [9, 54]) as fleet, fleet_station(fleet.core.uri) as url:
        await stream(fleet, url)
        await lose(fleet, url, journal)
