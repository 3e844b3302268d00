"""Robot task sets that are drained: no new robots come, and those that are there go to another one."""

from __future__ import annotations

import pytest
from support.master_world import World

from rce_master.http.entry import Entry
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.lifecycle import RobotSession

ROBOT = "anna/rob"


def drain(world: World, name: str = "r1", *, undo: bool = False) -> Changes:
    return world.do(commands.SetDraining(machine=name, draining=not undo))


def session(world: World) -> RobotSession:
    return world.state.tables.robot_live(ROBOT).session


def chosen(world: World) -> str:
    """Return where the master sends a robot now."""
    found = Entry(world.state.tables, lambda: 0.0).choose()
    return "" if found is None else found.process


def test_a_silent_task_set_gets_robots_only_if_no_other_is_there(two: World) -> None:
    silent = {"r2"}
    entry = Entry(two.state.tables, lambda: 0.0, lambda process: 4.0 * (process in silent))
    found = [entry.choose() for _ in range(2)]
    assert [one.process for one in found if one is not None] == ["r1", "r1"]
    silent.add("r1")
    assert entry.choose() is not None


@pytest.fixture
def two() -> World:
    """A robot with an interface at r1, and an empty task set r2."""
    world = World()
    world.robot_set("r1")
    world.login()
    world.interface("rob/out", "SubscriberConverter")
    world.robot_set("r2")
    return world


def test_robots_of_a_drained_task_set_go_elsewhere(two: World) -> None:
    changes = drain(two)
    assert [(one.process, one.id, one.elsewhere) for one in changes.withdrawals] == [("r1", ROBOT, True)]
    assert session(two) is RobotSession.ABSENT
    assert not two.state.tables.endpoints.count("task_set", "r1")
    assert chosen(two) == "r2"
    two.login(process="r2")
    assert session(two) is RobotSession.CONNECTED
    assert two.state.tables.interfaces.count("endpoint", ROBOT) == 1


def test_robots_stay_until_another_task_set_takes_them() -> None:
    world = World()
    world.robot_set("r1")
    world.login()
    assert not drain(world).withdrawals
    assert session(world) is RobotSession.CONNECTED
    assert chosen(world) == ""
    world.robot_set("r2")
    changes = world.do(commands.Tick())
    assert [one.id for one in changes.withdrawals] == [ROBOT]
    assert chosen(world) == "r2"


def test_undone_drain_takes_robots_again(two: World) -> None:
    drain(two)
    drain(two, "r2")
    assert chosen(two) == ""
    drain(two, undo=True)
    assert chosen(two) == "r1"


def test_machine_is_drained_with_all_its_task_sets(two: World) -> None:
    two.container_set("c1", name="m")
    drain(two, "m")
    assert {one.process for one in two.state.tables.drains} == {"r1", "r2", "c1"}
    drain(two, "m", undo=True)
    assert not len(two.state.tables.drains)


def test_drain_of_a_robot_task_set_ends_with_it(two: World) -> None:
    drain(two)
    two.do(commands.TaskSetLeft(process="r1"))
    two.now += two.state.settings.robot_grace + 1
    two.do(commands.Tick())
    assert not len(two.state.tables.drains)
