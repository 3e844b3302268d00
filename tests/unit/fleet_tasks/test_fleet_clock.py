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
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop, WhenLate
from rce_fleet.tasks.task import TaskState

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
    assert len(warned) == 4, "each manager warns once"


async def test_a_clock_that_was_once_ahead_ends_no_task(machine: Machine, tmp_path: Path) -> None:
    """Deadlines, starts and recurrences are the machine's times, also after a restart of the manager."""
    manager = FleetManager(
        Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
    )
    machine.wall += DAY
    manager.clock()
    machine.wall -= DAY
    await manager.step()
    stops, wall = (Stop(Action.GO, (5,)),), machine.wall
    ends = Order(stops, deadline=wall + 7200, when_late=WhenLate.FAIL)
    starts = Order(stops, earliest_start=wall + 7200)
    recurs = Order(stops, deadline=wall + 600, when_late=WhenLate.FAIL, every=3600.0)
    for order in (ends, starts, recurs):
        manager.book.create(order, manager.clock())
    await manager.step()
    tasks = [manager.book.tasks[number] for number in (1, 2, 3)]
    assert [task.state for task in tasks] == [TaskState.QUEUED] * 3
    assert tasks[1].reason == "waits for its earliest start"
    assert tasks[2].recurs_at == pytest.approx(wall + 3600)
    await manager.close()
    manager = FleetManager(
        Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
    )
    machine.wait(3601.0)
    await manager.step()
    await manager.step()
    states = [task.state for task in manager.book.tasks.values()]
    assert states == [TaskState.QUEUED, TaskState.QUEUED, TaskState.FAILED, TaskState.QUEUED]
    assert manager.book.tasks[4].order.deadline == pytest.approx(wall + 3600 + 600)
    machine.wait(3600.0)
    await manager.step()
    assert manager.book.tasks[1].state is TaskState.FAILED
    await manager.close()


async def test_a_clock_that_was_once_ahead_changes_no_order(machine: Machine, tmp_path: Path) -> None:
    """One due next day, and one from before the step, are not more urgent than one of a higher priority."""
    manager, robot, _ = begin(tmp_path, Stop(Action.GO, (9,)))
    robot.state = "silent"
    machine.wall += DAY
    manager.clock()
    machine.wall -= DAY
    stops = (Stop(Action.GO, (9,)),)
    for order in (Order(stops, deadline=machine.wall + DAY), Order(stops, priority=1)):
        manager.book.create(order, manager.clock())
    robot.state = "idle"
    await wait(machine, manager, 3)
    begun = [number for number, task in manager.book.tasks.items() if task.state is TaskState.RUNNING]
    assert begun == [3]
    await manager.close()


async def test_a_forward_step_makes_no_robot_stuck(machine: Machine, tmp_path: Path) -> None:
    manager = FleetManager(
        Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
    )
    robot = manager.facts.robots["Robot1"] = RobotFacts("Robot1", "driving", cell=0, moved_at=manager.clock())
    machine.wall += DAY
    await manager.step()
    assert robot.moved_at == manager.clock()
    await manager.close()


@pytest.mark.parametrize("is_before", [True, False])
async def test_a_robot_that_falls_silent_at_a_forward_step(
    machine: Machine, tmp_path: Path, is_before: bool
) -> None:
    """The planner says so just before the clock is set, or before the manager has noticed that it was."""
    manager = FleetManager(
        Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")
    )
    robot = manager.facts.robots["Robot1"] = RobotFacts("Robot1", "silent", cell=0)
    for jump in (0.0, DAY):
        machine.wall += jump
        if is_before is (jump == 0.0):
            robot.moved_at = robot.away_since = manager.clock()
    machine.wait(0.1)
    await manager.step()
    machine.wait(20.0)
    await manager.step()
    assert manager.clock() - robot.away_since == pytest.approx(20.1, abs=0.11)
    assert manager.clock() - robot.moved_at == pytest.approx(20.1, abs=0.11)
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


def begin(tmp_path: Path, *stops: Stop) -> tuple[FleetManager, RobotFacts, int]:
    """Return a manager, its robot, which is in cell 5, and the number of a task with these stops."""
    journal = Journal(tmp_path / "j.sqlite")
    manager = FleetManager(journal, Planner(), TaskRules(), logging.getLogger("manager"))
    manager.facts.grid, manager.facts.is_live = GridMap(), True
    robot = RobotFacts("Robot1", "idle", cell=5, moved_at=manager.clock())
    manager.facts.robots["Robot1"] = robot
    return manager, robot, manager.book.create(Order(stops), manager.clock()).number


async def wait(machine: Machine, manager: FleetManager, seconds: int) -> None:
    for _ in range(seconds):
        machine.wait(1.0)
        await manager.step()


async def test_a_forward_step_ends_no_action(machine: Machine, tmp_path: Path) -> None:
    """The robot's arm is in the shelf for a minute, whatever the clock says."""
    manager, _, number = begin(tmp_path, Stop(Action.PICK, (5,), 60.0), Stop(Action.DELIVER, (5,), 1.0))
    await wait(machine, manager, 3)
    for _ in range(2):
        machine.wall += 3600.0
        await wait(machine, manager, 20)
        assert manager.book.tasks[number].action is not None
    await wait(machine, manager, 25)
    assert manager.book.tasks[number].state is TaskState.DONE
    await manager.close()


async def test_a_forward_step_loses_no_load(machine: Machine, tmp_path: Path) -> None:
    """A task whose load is on a silent robot fails after an hour, and not when the clock is set."""
    manager, robot, number = begin(tmp_path, Stop(Action.PICK, (5,)), Stop(Action.DELIVER, (9,), 1.0))
    await wait(machine, manager, 3)
    robot.state, robot.away_since = "silent", manager.clock()
    await wait(machine, manager, 30)
    assert manager.book.tasks[number].state is TaskState.SUSPENDED
    machine.wall += DAY
    await wait(machine, manager, 30)
    assert manager.book.tasks[number].state is TaskState.SUSPENDED
    await manager.close()


async def test_a_forward_step_takes_no_task_from_an_unknown_robot(machine: Machine, tmp_path: Path) -> None:
    """The planner was restarted, and does not know the robot for some seconds."""
    manager, robot, number = begin(tmp_path, Stop(Action.GO, (9,)))
    await wait(machine, manager, 3)
    del manager.facts.robots["Robot1"]
    await wait(machine, manager, 2)
    machine.wall += DAY
    await wait(machine, manager, 2)
    assert manager.book.tasks[number].robot == robot.id
    await manager.close()
