"""When the leading master of a demo is killed, and what the report says of it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from random import Random

import aiohttp
import pytest
from support.fleet_states import truth

from rce_fleet.demo import masters
from rce_fleet.demo.masters import LeaderView, MasterKills
from rce_fleet.drivers.report import WorldReport


class Floor:
    """A robot that stands or drives, and a master that leads again when it is looked for."""

    def __init__(self) -> None:
        self.distance = 0.0
        self.drives = False
        self.looks = 0
        self.kills = 0

    def truth(self) -> WorldReport:
        self.looks += 1
        if self.drives:
            self.distance += 0.1
        report = truth({"Robot1": 3})
        report.robots[0].distance_m = self.distance
        return report

    async def kill(self, urls: Sequence[str]) -> LeaderView:
        self.kills += 1
        return LeaderView(urls[0], self.kills, 2)

    async def leader(self, session: aiohttp.ClientSession, urls: Sequence[str]) -> LeaderView:
        return LeaderView(urls[0], self.kills + 1, 2)


@pytest.fixture
def floor(monkeypatch: pytest.MonkeyPatch) -> Floor:
    floor = Floor()
    monkeypatch.setattr(masters, "kill_leader", floor.kill)
    monkeypatch.setattr(masters, "find_leader", floor.leader)
    monkeypatch.setattr(masters, "CALM_S", (0.0, 0.0))
    monkeypatch.setattr(masters, "_POLL_S", 0.001)
    return floor


async def test_a_master_is_killed_while_a_robot_drives(floor: Floor) -> None:
    kills = MasterKills(["http://m1/"], Random(1), floor.truth, lambda _: None)

    async def run() -> None:
        async with asyncio.timeout(30):
            while floor.looks < 10:
                await asyncio.sleep(0.001)
            assert not floor.kills, "all stand"
            floor.drives = True
            while floor.kills < 2:
                await asyncio.sleep(0.001)

    await kills.beside(run())
    assert not kills.faults
    report = kills.as_json()
    assert report["kills"] == len(report["changes"]) >= 2
    assert min(change["driven_m"] for change in report["changes"]) > 0


async def test_a_run_without_a_kill_is_at_fault(floor: Floor) -> None:
    kills = MasterKills(["http://m1/"], Random(1), floor.truth, lambda _: None)
    await kills.beside(asyncio.sleep(0.01))
    assert kills.faults == ["the leading master was not killed: the run was too short, or no robot drove"]
