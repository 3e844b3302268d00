"""Robots that connect, move between task sets and come back."""

from __future__ import annotations

import pytest
from support.master_world import World
from support.state_reports import kinds, status

from rce.control.model import (
    EndpointState,
    EndpointStatus,
    LinkAddress,
    StatusPatch,
)
from rce_master.exceptions import ConflictError
from rce_master.state import commands
from rce_master.state.settings import StateSettings


def test_robot_within_grace_time_finds_everything(world: World) -> None:
    """A robot is kept for its grace time and finds everything again."""
    world.wired()
    before = world.spec("rob")
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    assert world.session() == "absent"
    world.tick(59)
    changes = world.login()
    assert world.spec("rob") == before
    assert changes.answered == "anna/rob"
    assert world.session() == "connected"
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    changes = world.tick(60)
    assert kinds(changes) == ["robot_gone"]
    assert [(w.process, w.id) for w in changes.withdrawals] == [("r1", "anna/rob")]
    assert world.spec("c").connections == ()
    assert world.phase() == "placed"


def test_robots_with_many_interfaces_are_removed_one_by_one() -> None:
    """A save of all of them might be too large for the store."""
    world = World(StateSettings(max_work=1000))
    world.robot_set()
    for robot in ("a", "b", "c"):
        world.login(robot)
        for number in range(100):
            world.interface(f"{robot}/in{number}", "PublisherConverter")
        world.do(commands.RobotLeft(process="r1", id=f"anna/{robot}"))
    assert kinds(world.tick(60)) == ["robot_gone"]
    changes = world.do(commands.Continue())
    assert (kinds(changes), changes.unfinished) == (["robot_gone"], True)
    assert kinds(world.do(commands.Continue())) == ["robot_gone"]
    assert not world.state.tables.interfaces


def test_a_robot_connects_once(world: World) -> None:
    world.wired()
    world.robot_set("r2")
    with pytest.raises(ConflictError, match="connected already"):
        world.login(process="r2")
    with pytest.raises(ConflictError, match="is not a connected robot task set"):
        world.login("other", process="c1")


def test_a_robot_moves_to_another_task_set(world: World) -> None:
    world.wired()
    world.login("abel")
    world.interface("abel/in", "PublisherConverter")
    world.connect("abel/in", "rob/out")
    world.robot_set("r2", port=2)
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    changes = world.login(process="r2")
    assert [(w.process, w.id) for w in changes.withdrawals] == [("r1", "anna/rob")]
    assert "anna/abel" in changes.touched
    (link,) = world.spec("abel").links
    assert (link.dial, link.address.port) == (True, 2)


def test_peers_learn_that_a_robot_left_a_task_set(world: World) -> None:
    """The task set may hang or be cut off, and dial again before it hears of it."""
    world.wired()
    (former,) = world.spec("rob").links
    assert world.spec("c").links[0].peer_epoch == former.epoch
    world.robot_set("r2", port=2)
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    changes = world.login(process="r2")
    (present,) = world.spec("rob").links
    assert present.epoch > former.epoch
    assert world.spec("c").links[0].peer_epoch == present.epoch
    assert list(changes.touched["anna/c"].links) == [present.id]
    changes = world.login("other", process="r2")
    assert "anna/c" not in changes.touched


def test_robots_of_a_killed_task_set_come_back_at_another(world: World) -> None:
    world.wired()
    before = world.spec("rob")
    world.leave("r1")
    assert world.session() == "absent"
    world.robot_set("r2")
    changes = world.login(process="r2")
    assert changes.withdrawals == []
    assert world.spec("rob").connections == before.connections
    world.tick(60)
    assert "r1" not in world.state.tables.task_sets
    assert world.session() == "connected"


def test_a_channel_that_dropped_for_a_while_changes_nothing(world: World) -> None:
    world.wired()
    world.run()
    before = world.spec("rob"), world.spec("c")
    world.leave("r1")
    world.leave("c1")
    world.tick(29)
    world.robot_set(endpoints=(status("rob", revision=before[0].revision),))
    world.container_set(
        endpoints=(status("c", revision=before[1].revision, address=LinkAddress(machine="m", unix="/run/c")),)
    )
    assert (world.spec("rob"), world.spec("c")) == before
    assert (world.session(), world.phase()) == ("connected", "running")


def test_a_robot_that_its_task_set_lost_meanwhile_is_absent(world: World) -> None:
    world.wired()
    world.leave("r1")
    world.robot_set()
    assert world.session() == "absent"
    world.login(arrives=False)
    world.report("r1", status("rob", EndpointState.ABSENT))
    assert world.session() == "connected", "its task set has not heard of it yet"
    world.report("r1", status("rob"))
    world.tick(60)
    assert world.session() == "connected"
    world.report("r1", status("rob", EndpointState.ABSENT))
    assert world.session() == "absent"
    world.report("r1", status("rob"))
    assert world.session() == "connected"


def test_a_robot_that_was_let_in_and_never_came_can_log_in_again(world: World) -> None:
    world.robot_set()
    world.login(arrives=False)
    world.tick(14)
    with pytest.raises(ConflictError):
        world.login()
    world.tick(1)
    assert world.session() == "absent"
    world.login()


def test_a_new_password_ends_the_sessions_of_the_users_robots(world: World) -> None:
    world.wired()
    before = world.spec("rob")
    changes = world.do(commands.SetPassword(name="anna", password="new"))
    assert [(w.process, w.id) for w in changes.withdrawals] == [("r1", "anna/rob")]
    assert world.session() == "absent"
    world.report("r1", status("rob"))
    assert world.session() == "absent"
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    world.do(commands.EndpointGone(process="r1", id="anna/rob"))
    world.login()
    after = world.spec("rob")
    assert after.revision > changes.withdrawals[0].revision
    assert (after.interfaces, after.connections) == (before.interfaces, before.connections)
    assert world.session() == "connected"


@pytest.mark.parametrize("in_patch", [False, True])
def test_robot_connected_where_it_is_not_placed_is_dropped(world: World, in_patch: bool) -> None:
    """It was sent away before its task set had the answer to its login."""
    world.wired()
    world.robot_set("r2")

    def report(process: str, state: EndpointState, id_: str = "anna/rob") -> list[tuple[str, str]]:
        there = EndpointStatus(id=id_, revision=1, state=state, number=7)
        command = (
            commands.StatusPatched(process=process, patch=StatusPatch(status=there))
            if in_patch
            else commands.StatusReported(process=process, status=there)
        )
        changes = world.do(command)
        for drop in changes.withdrawals:
            assert drop.revision > world.spec("rob").revision
        return [(drop.process, drop.id) for drop in changes.withdrawals]

    assert report("r1", EndpointState.RUNNING) == []
    assert report("r2", EndpointState.RUNNING) == [("r2", "anna/rob")]
    assert report("r2", EndpointState.ABSENT) == []
    assert report("r2", EndpointState.RUNNING, "anna/removed") == [("r2", "anna/removed")]
    assert report("c1", EndpointState.RUNNING) == []
    world.leave("r2")
    assert report("r2", EndpointState.RUNNING) == []
    assert world.session() == "connected"
    world.do(commands.SetPassword(name="anna", password="new"))
    assert report("r1", EndpointState.RUNNING) == [("r1", "anna/rob")]
    assert world.session() == "absent"
