"""Goals that people set for robots: kept in the journal, sent again after restarts, ended by others."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.journal.journal import Journal
from rce_fleet.manager.goals import NO_ANSWER, GoalKeeper
from rce_fleet.manager.manager import FleetManager
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import CellBlock, GoalEntry, Places, PlannerRun, RobotEntry, Zone
from rce_fleet.tasks.task import TaskState
from rce_fleet.tasks.zone_costs import OwnCosts

RUN = PlannerRun("1.0", "8 x 8")
LATER = PlannerRun("2.0", "8 x 8")


class Planner:
    """Takes goals over at once, into the facts; while it is down it does not answer."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotFacts] = {}
        self.sent: list[tuple[str, int | None]] = []
        self.refusal = ""

    async def set_goal(self, robot: str, cell: int | None) -> str:
        self.sent.append((robot, cell))
        if not self.refusal:
            self.robots[robot].goal = cell
            self.robots[robot].state = "idle" if cell is None else "driving"
        return self.refusal

    async def block_cell(self, cell: int, block: CellBlock | None, now: float) -> str:
        raise AssertionError(cell, block, now)

    async def set_mode(self, robot: str, mode: str, reason: str, user: str) -> str:
        del reason, user
        self.robots[robot].mode, self.robots[robot].goal = mode, None
        return ""

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        raise AssertionError(name, zone, now)

    async def set_costs(self, costs: OwnCosts) -> str:
        raise AssertionError(costs)


class Fleet:
    """A manager with a journal, beside a planner with two robots."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.planner = Planner()
        self.now = 1000.0
        self.start(RUN)

    def start(self, run: PlannerRun) -> None:
        """Start the manager; a planner of another run knows no goals."""
        log = logging.getLogger("manager")
        self.journal = Journal(self.path)
        self.manager = FleetManager(self.journal, self.planner, TaskRules(), log, clock=lambda: self.now)
        facts = self.manager.facts
        facts.grid, facts.is_live, facts.is_current = GridMap(), True, True
        for name, cell in (("Robot1", 0), ("Robot2", 7)):
            known = self.planner.robots.get(name)
            same = run == RUN and known is not None
            facts.robots[name] = known if same and known else RobotFacts(name, "idle", cell=cell)
        self.planner.robots = facts.robots
        self.manager.planner_began(run)

    async def step(self) -> None:
        self.now += 2.0
        await self.manager.step()

    def task(self) -> TaskState:
        return self.manager.book.tasks[1].state

    async def with_task(self) -> None:
        """Let the first robot drive for a task."""
        self.manager.book.create(Order((Stop(Action.GO, (5,)),), robot="Robot1"), self.now)
        await self.step()
        await self.step()
        assert (self.robot().goal, self.task()) == (5, TaskState.RUNNING)

    def robot(self, name: str = "Robot1") -> RobotFacts:
        return self.manager.facts.robots[name]


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    made = Fleet(tmp_path / "j.sqlite")
    yield made
    await made.manager.close()


async def test_a_goal_survives_manager_and_planner(fleet: Fleet) -> None:
    assert await fleet.manager.set_goal("Robot1", 20, "anna") == ""
    await fleet.step()
    assert fleet.manager.book.goals["Robot1"] == GoalEntry("Robot1", 20, "anna")
    await fleet.manager.close()
    fleet.start(LATER)
    await fleet.step()
    assert (fleet.robot().goal, fleet.planner.sent[-1]) == (20, ("Robot1", 20))
    assert fleet.robot().by_hand


async def test_a_goal_is_sent_once_the_planner_is_back(fleet: Fleet) -> None:
    fleet.manager.facts.is_live = False
    assert await fleet.manager.set_goal("Robot1", 20, "anna") == ""
    assert fleet.planner.sent == []
    await fleet.manager.close()
    fleet.start(RUN)
    await fleet.step()
    assert fleet.planner.sent == [("Robot1", 20)]
    await fleet.step()
    await fleet.step()
    assert not fleet.manager.book.goals["Robot1"].unsent
    assert fleet.planner.sent == [("Robot1", 20)]


async def test_a_goal_changed_without_the_manager_counts(fleet: Fleet) -> None:
    await fleet.manager.set_goal("Robot1", 20, "anna")
    await fleet.step()
    await fleet.manager.close()
    fleet.robot().goal = 30
    fleet.start(RUN)
    await fleet.step()
    assert fleet.manager.book.goals["Robot1"] == GoalEntry("Robot1", 30)
    assert fleet.planner.sent == [("Robot1", 20)]


async def test_a_goal_of_another_program_is_kept(fleet: Fleet) -> None:
    fleet.robot().goal, fleet.robot().state = 33, "driving"
    await fleet.step()
    await fleet.manager.close()
    fleet.start(LATER)
    await fleet.step()
    assert fleet.planner.sent == [("Robot1", 33)]


@pytest.mark.parametrize("cell", [20, None])
async def test_a_goal_holds_the_task_until_it_is_resumed(fleet: Fleet, cell: int | None) -> None:
    await fleet.with_task()
    assert await fleet.manager.set_goal("Robot1", cell, "anna") == ""
    await fleet.step()
    await fleet.step()
    assert (fleet.robot().goal, fleet.task()) == (cell, TaskState.HELD)
    assert "anna" in fleet.manager.book.tasks[1].reason
    fleet.manager.book.resume("T1", fleet.now)
    if cell is not None:
        fleet.robot().cell, fleet.robot().state = cell, "arrived"
    for _ in range(3):
        await fleet.step()
    assert (fleet.robot().goal, fleet.task()) == (5, TaskState.RUNNING)
    assert fleet.manager.book.goals == {}


async def test_a_loaded_robot_goes_where_a_person_sends_it(fleet: Fleet) -> None:
    stops = (Stop(Action.PICK, (0,), duration=0.0), Stop(Action.DELIVER, (40,)))
    fleet.manager.book.create(Order(stops, robot="Robot1"), fleet.now)
    for _ in range(5):
        await fleet.step()
        if fleet.robot().goal is not None and fleet.robot().cell == fleet.robot().goal:
            fleet.robot().state = "arrived"
    assert fleet.robot().goal == 40
    await fleet.manager.set_goal("Robot1", 20, "anna")
    for _ in range(3):
        await fleet.step()
    assert (fleet.robot().goal, fleet.task()) == (20, TaskState.HELD)


async def test_a_stop_during_a_step_holds_the_task(fleet: Fleet) -> None:
    """The planner has taken it over before the step comes to what was confirmed."""
    await fleet.with_task()
    parts = fleet.manager.dispatcher.parts

    def stop_now(now: float, facts: FleetFacts) -> Iterator[None]:
        entry = fleet.manager.hand_goals.request("Robot1", None, fleet.now, "anna")
        with fleet.manager.hand_goals.asking(entry, fleet.now):
            fleet.robot().goal, fleet.robot().state = None, "idle"
        yield from parts(now, facts)

    fleet.manager.dispatcher.parts = stop_now  # type: ignore[method-assign]
    await fleet.step()
    del fleet.manager.dispatcher.parts
    await fleet.step()
    assert (fleet.robot().goal, fleet.task()) == (None, TaskState.HELD)


async def test_a_stop_counts_while_other_goals_are_sent(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    for robot, cell in (("Robot1", 5), ("Robot2", 60)):
        fleet.manager.book.create(Order((Stop(Action.GO, (cell,)),), robot=robot), fleet.now)
    send = fleet.planner.set_goal

    async def stop_the_other(robot: str, cell: int | None) -> str:
        monkeypatch.setattr(fleet.planner, "set_goal", send)
        other = "Robot2" if robot == "Robot1" else "Robot1"
        assert await fleet.manager.set_goal(other, None, "anna") == ""
        return await send(robot, cell)

    monkeypatch.setattr(fleet.planner, "set_goal", stop_the_other)
    for _ in range(3):
        await fleet.step()
    (stopped,) = [robot for robot, cell in fleet.planner.sent if cell is None]
    assert [cell for robot, cell in fleet.planner.sent if robot == stopped] == [None]


async def test_a_planner_that_falls_silent_gets_the_other_goals_later(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each further call would wait for an answer, too."""
    for robot, cell in (("Robot1", 5), ("Robot2", 60)):
        fleet.manager.book.create(Order((Stop(Action.GO, (cell,)),), robot=robot), fleet.now)
    send = fleet.planner.set_goal
    asked: list[str] = []

    async def fall_silent(robot: str, cell: int | None) -> str:
        del cell
        asked.append(robot)
        fleet.manager.facts.is_live = False
        return NO_ANSWER

    monkeypatch.setattr(fleet.planner, "set_goal", fall_silent)
    for _ in range(3):
        await fleet.step()
    assert len(asked) == 1
    monkeypatch.setattr(fleet.planner, "set_goal", send)
    fleet.manager.facts.is_live = True
    for _ in range(10):
        await fleet.step()
    assert sorted(fleet.planner.sent) == [("Robot1", 5), ("Robot2", 60)]


async def test_a_parking_robot_is_not_sent_by_another_program(fleet: Fleet) -> None:
    """The manager that sent it there was killed."""
    fleet.manager.book.emit(Places(parking=(20,)), "places", fleet.now)
    while not fleet.planner.sent:
        await fleet.step()
    ((robot, _),) = fleet.planner.sent
    await fleet.manager.close()
    fleet.start(RUN)
    await fleet.step()
    assert fleet.manager.book.goals == {}
    assert not fleet.robot(robot).by_hand


async def test_a_refused_goal_leaves_everything_as_it_was(fleet: Fleet) -> None:
    await fleet.with_task()
    fleet.planner.refusal = "cell 20 is blocked"
    assert await fleet.manager.set_goal("Robot1", 20, "anna") == "cell 20 is blocked"
    fleet.planner.refusal = ""
    for _ in range(3):
        await fleet.step()
    assert (fleet.robot().goal, fleet.task()) == (5, TaskState.RUNNING)
    assert fleet.manager.book.goals == {}
    fleet.planner.refusal = f"{NO_ANSWER}: closed"
    assert (await fleet.manager.set_goal("Robot2", 20, "anna")).startswith(NO_ANSWER)
    assert fleet.manager.book.goals == {}


async def test_two_refused_goals_leave_the_one_before(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one came before the planner had answered the first one."""
    assert await fleet.manager.set_goal("Robot1", 20, "anna") == ""
    before = fleet.manager.book.goals["Robot1"]
    asked, answered = asyncio.Event(), asyncio.Event()

    async def refuse(_robot: str, _cell: int | None) -> str:
        asked.set()
        await answered.wait()
        return f"{NO_ANSWER}: closed"

    monkeypatch.setattr(fleet.planner, "set_goal", refuse)
    async with asyncio.timeout(60):
        first = asyncio.create_task(fleet.manager.set_goal("Robot1", 30, "anna"))
        await asked.wait()
        second = asyncio.create_task(fleet.manager.set_goal("Robot1", 40, "bob"))
        await asyncio.sleep(0)
        answered.set()
        assert [await each for each in (first, second)] == [f"{NO_ANSWER}: closed"] * 2
    assert fleet.manager.book.goals["Robot1"] == before


async def test_a_robot_that_is_taken_out_loses_its_goal(fleet: Fleet) -> None:
    await fleet.manager.set_goal("Robot1", 20, "anna")
    await fleet.step()
    out = RobotEntry("Robot1", "out_of_service", user="anna", unsent=True)
    fleet.manager.book.emit(out, "taken out", fleet.now)
    await fleet.step()
    await fleet.step()
    assert fleet.manager.book.goals == {}
    with pytest.raises(TaskRefusedError, match="out of service"):
        await fleet.manager.set_goal("Robot1", 21, "anna")


async def test_another_grid_ends_goals(fleet: Fleet) -> None:
    await fleet.manager.set_goal("Robot1", 20, "anna")
    await fleet.step()
    await fleet.manager.close()
    fleet.start(PlannerRun("2.0", "4 x 4"))
    await fleet.step()
    assert (fleet.manager.book.goals, fleet.planner.sent) == ({}, [("Robot1", 20)])


async def test_a_robot_at_its_goal_makes_room_for_a_task(fleet: Fleet) -> None:
    await fleet.manager.set_goal("Robot1", 5, "anna")
    await fleet.step()
    fleet.robot().cell, fleet.robot().state = 5, "arrived"
    fleet.manager.book.create(Order((Stop(Action.GO, (5,)),), robot="Robot2"), fleet.now)
    for _ in range(4):
        await fleet.step()
    assert fleet.robot("Robot2").goal == 5
    assert fleet.robot().goal != 5


async def test_a_robot_that_joins_late_gets_its_goal(fleet: Fleet) -> None:
    """The planner was restarted, and does not know the robot at first."""
    await fleet.manager.set_goal("Robot1", 20, "anna")
    await fleet.step()
    robot = fleet.robot()
    robot.is_known, robot.state, robot.goal = False, "joining", None
    fleet.manager.planner_began(LATER)
    await fleet.step()
    robot.is_known, robot.state = True, "idle"
    await fleet.step()
    await fleet.step()
    assert fleet.robot().goal == 20
    assert fleet.manager.book.goals["Robot1"].cell == 20


class CountedGoals(dict[str, int | None]):
    """Goals by robot; counts how often one looks at all of them."""

    looks = 0

    def items(self) -> Any:
        self.looks += 1
        return super().items()

    def values(self) -> Any:
        self.looks += 1
        return super().values()


def test_goals_of_robots_at_rest_are_compared_once() -> None:
    """One of them is in the cell to which another robot shall go: it loses its goal."""
    facts = FleetFacts()
    for cell in range(40):
        facts.robots[f"R{cell}"] = RobotFacts(f"R{cell}", "arrived", cell=cell, goal=cell)
    facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=50)
    wanted = CountedGoals({"Robot1": 3})
    assert GoalKeeper().to_send(facts, wanted, 1.0) == [("R3", None), ("Robot1", 3)]
    assert wanted.looks == 1
