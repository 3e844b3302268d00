"""The fleet's time, and that of the machine, which people and time servers set."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path

import pytest
from support.fleet_manager import Planner

from rce_fleet.journal.journal import Journal
from rce_fleet.manager import clock as clocks
from rce_fleet.manager.clock import SLOWER, WallClock
from rce_fleet.manager.manager import FleetManager
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop

DAY = 86400.0


class Machine:
    """The clocks of a machine."""

    def __init__(self) -> None:
        self.wall, self.since_start = 1_800_000_000.0, 100.0

    def time(self) -> float:
        return self.wall

    def monotonic(self) -> float:
        return self.since_start

    def wait(self, seconds: float) -> None:
        self.wall += seconds
        self.since_start += seconds


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    made = Machine()
    monkeypatch.setattr(clocks, "time", made)
    return made


def test_forward_steps_are_followed(machine: Machine) -> None:
    clock = WallClock()
    machine.wait(10.0)
    assert clock() == machine.wall
    machine.wall += DAY
    machine.wait(1.0)
    assert clock() == machine.wall
    assert clock.stepped == pytest.approx(DAY)


def test_a_step_back_makes_it_slower_until_both_agree(machine: Machine) -> None:
    clock = WallClock()
    before = clock()
    machine.wall -= 3.0
    assert clock() == before
    machine.wait(10.0)
    assert clock() == pytest.approx(before + 10 * SLOWER)
    machine.wait(100.0)
    assert (clock(), clock.stepped) == (machine.wall, 0.0)


async def test_a_lead_shrinks_over_restarts(
    machine: Machine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The manager ran once on a machine that was a day ahead; its journal is moved to a right one."""
    leads = list[float]()
    for number in range(4):
        manager = FleetManager(
            Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
        )
        if number == 0:
            machine.wall += DAY
        manager.book.create(Order((Stop(Action.GO, (5,)),)), manager.clock())
        await manager.step()
        if number == 0:
            machine.wall -= DAY
        begin = manager.clock()
        for _ in range(60):
            machine.wait(60.0)
            assert manager.clock() > begin
        manager.book.create(Order((Stop(Action.GO, (5,)),)), manager.clock())
        await manager.step()
        leads.append(manager.clock() - machine.wall)
        await manager.close()
        machine.wait(60.0)
    assert leads[0] == pytest.approx(DAY - 360.0)
    assert all(after < before - 400.0 for before, after in pairwise(leads))
    warned = [record.getMessage() for record in caplog.records if "ahead of this machine" in record.message]
    assert len(warned) == 3


async def test_a_forward_step_makes_no_robot_stuck(machine: Machine, tmp_path: Path) -> None:
    manager = FleetManager(
        Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
    )
    robot = manager.facts.robots["Robot1"] = RobotFacts("Robot1", "driving", cell=0, moved_at=manager.clock())
    machine.wall += DAY
    await manager.step()
    assert robot.moved_at == manager.clock()
    await manager.close()


async def test_a_forward_step_is_no_time_of_robots(machine: Machine, tmp_path: Path) -> None:
    """The utilization of the next day would be that of the moment at which the clock was set."""
    journal = Journal(tmp_path / "j.sqlite")
    manager = FleetManager(journal, Planner(), TaskRules(), logging.getLogger("manager"))
    manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0, moved_at=manager.clock())
    machine.wait(30.0)
    await manager.step()
    machine.wall += DAY / 4
    machine.wait(1.0)
    await manager.step()
    machine.wait(60.0)
    await manager.step()
    assert sum(total for _, _, total in journal.minutes()) == pytest.approx(31.0)
    await manager.close()
