"""Robots, containers and task sets over time: placement, absence, adoption, restarts."""

from __future__ import annotations

import pytest
from support.master_world import World, restarted
from support.state_reports import MB, kinds, status

from rce.control.model import (
    EndpointState,
    EndpointStatus,
    LinkAddress,
    NodeState,
    NodeStatus,
)
from rce_master.exceptions import ConflictError, InvalidRequestError, NotFoundError, TransitionError
from rce_master.state import commands
from rce_master.state.lifecycle import (
    CONTAINER_LIFE,
    ROBOT_LIFE,
    ContainerEvent,
    ContainerPhase,
    RobotEvent,
    RobotSession,
)


def test_lifecycles_refuse_what_cannot_happen() -> None:
    with pytest.raises(TransitionError, match="robot is connected: expected leave, found login"):
        ROBOT_LIFE.advance(RobotSession.CONNECTED, RobotEvent.LOGIN)
    with pytest.raises(TransitionError, match="container is requested: expected place, found running"):
        CONTAINER_LIFE.advance(ContainerPhase.REQUESTED, ContainerEvent.RUNNING)
    for phase in ContainerPhase:
        if phase.is_placed:
            reached = {CONTAINER_LIFE.advance(phase, event) for event in ContainerEvent}
            assert reached == set(ContainerPhase) - {ContainerPhase.REQUESTED}
        else:
            assert CONTAINER_LIFE.advance(phase, ContainerEvent.PLACE) is ContainerPhase.PLACED


# Placement


def test_waiting_container_tells_its_user_once(world: World) -> None:
    """A container waits for a machine and its user is told once."""
    world.container()
    assert world.phase() == "requested"
    assert world.tick(9).notices == []
    (notice,) = world.tick(1).notices
    assert notice.to == "anna"
    assert "no container task set is connected" in notice.text
    assert world.tick(60).notices == []
    changes = world.container_set()
    assert world.phase() == "placed"
    assert "anna/c" in changes.touched


def test_containers_spread_over_machines(world: World) -> None:
    world.container_set("c1")
    world.container_set("c2")
    for tag in "abcd":
        world.container(tag)
    tables = world.state.tables
    assert [tables.endpoints[f"anna/{tag}"].task_set for tag in "abcd"] == ["c1", "c2", "c1", "c2"]


def test_features_and_memory_are_respected(world: World) -> None:
    world.container_set("c1", memory=100 * MB)
    gpu = world.container("gpu", wait=True, special_features=("gpu",))
    world.container("big", memory=60 * MB)
    bigger = world.container("bigger", wait=True, memory=50 * MB)
    assert [world.phase(tag) for tag in ("gpu", "big", "bigger")] == ["requested", "placed", "requested"]
    assert "m lacks the label gpu" in gpu.notices[0].text
    assert "m has 40 of 100 MB memory free, 50 MB needed" in bigger.notices[0].text
    assert world.tick(10).notices == []
    world.container_set("c2", labels=("gpu",))
    assert [world.phase(tag) for tag in ("gpu", "bigger")] == ["placed", "placed"]


def test_remade_container_waits_for_its_predecessor(world: World) -> None:
    """A container made again waits until its former self is gone."""
    world.wired()
    world.run()
    (drop,) = world.do(commands.DestroyContainer(user="anna", tag="c")).withdrawals
    assert set(world.container().touched) == {"anna/c"}
    assert world.phase() == "requested"
    world.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert world.phase() == "placed"
    assert world.spec("c").revision > drop.revision


def test_a_container_that_its_task_set_ended_is_placed_anew(world: World) -> None:
    world.wired()
    world.run()
    changes = world.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert world.phase() == "placed"
    assert {"anna/c", "anna/rob"} <= set(changes.touched)
    assert world.spec("rob").links[0].address == LinkAddress()


# What is reported


def test_a_containers_address_goes_to_who_dials_it(world: World) -> None:
    world.wired()
    assert world.spec("rob").links[0].address == LinkAddress()
    changes = world.run(incarnation="1")
    assert set(changes.touched) == {"anna/rob"}
    assert world.spec("rob").links[0].address.unix == "/run/c"
    assert set(world.run(incarnation="1").touched) == set()
    changes = world.report("c1", status("c", EndpointState.STARTING, incarnation="2"))
    assert set(changes.touched) == {"anna/rob"}
    assert world.spec("rob").links[0].address == LinkAddress()
    assert kinds(changes) == ["container_starting"]


def test_what_happens_to_nodes_becomes_events(world: World) -> None:
    world.wired()
    world.node("c", "n")
    up = world.run(nodes=(NodeStatus(tag="n", state=NodeState.RUNNING, pid=1),))
    assert kinds(up) == ["container_running", "node_running"]
    down = world.run(nodes=(NodeStatus(tag="n", state=NodeState.FAILED, exit_code=-9),))
    assert [(h.kind, h.subject, h.text) for h in down.events] == [
        ("node_failed", "anna/c/n", "ended by signal 9")
    ]
    assert kinds(world.run(nodes=(NodeStatus(tag="n", state=NodeState.FAILED, exit_code=-9),))) == []


def test_a_restart_that_was_not_seen_is_an_event(world: World) -> None:
    world.wired()
    world.run(incarnation="1")
    assert kinds(world.run(incarnation="2")) == ["container_restarted"]


def test_reports_of_what_is_not_placed_there_are_ignored(world: World) -> None:
    world.wired()
    world.container_set("c2")
    changes = world.report("c2", status("c", EndpointState.FAILED))
    assert world.phase() == "placed"
    assert changes.rows() == []


def test_faults_reach_the_user(world: World) -> None:
    world.wired()
    (notice,) = world.do(commands.FaultReported(id="anna/c", text="no such package")).notices
    assert (notice.to, notice.text) == ("anna", "no such package")
    fault = commands.FaultReported(id="anna/c", text="bad", robot="anna/rob")
    assert world.do(fault).notices[0].to == "anna/rob"
    with pytest.raises(NotFoundError):
        world.do(commands.FaultReported(id="zoe/c", text="x"))


# Robots


# Container task sets that go


def test_containers_of_a_machine_that_stays_away_move(world: World) -> None:
    world.wired()
    world.run()
    world.container_set("c2")
    world.leave("c1")
    assert world.tick(29).events == []
    assert world.phase() == "running"
    changes = world.tick(1)
    assert world.state.tables.endpoints["anna/c"].task_set == "c2"
    assert world.phase() == "placed"
    assert kinds(changes) == ["container_lost", "task_set_gone", "container_placed"]
    assert "was lost with its machine" in changes.notices[0].text
    world.container_set("c1", endpoints=(status("c"),))
    assert world.state.tables.endpoints["anna/c"].task_set == "c2"


def test_lost_container_is_bound_to_returning_machine(world: World) -> None:
    """A lost container is bound again if its machine comes back first."""
    world.wired()
    world.run()
    before = world.spec("c")
    world.leave("c1")
    world.tick(30)
    assert world.phase() == "lost"
    world.container_set(
        endpoints=(status("c", revision=before.revision, address=LinkAddress(machine="m", unix="/run/c")),)
    )
    assert world.phase() == "running"
    assert world.spec("c").connections == before.connections
    assert world.spec("rob").links[0].address.unix == "/run/c"


def test_a_machine_that_lost_its_containers_makes_them_again(world: World) -> None:
    world.wired()
    world.run()
    world.leave("c1")
    world.container_set()
    assert world.phase() == "placed"
    assert world.spec("rob").links[0].address == LinkAddress()


# A restarted master


def test_a_restarted_master_desires_the_same(world: World) -> None:
    world.wired()
    world.run()
    before = world.spec("rob"), world.spec("c")
    new = restarted(world)
    assert (new.spec("rob"), new.spec("c")) == before
    assert (new.session(), new.phase()) == ("absent", "placed")
    address = LinkAddress(machine="m", unix="/run/c")
    robots = new.robot_set(endpoints=(status("rob", revision=before[0].revision),))
    containers = new.container_set(endpoints=(status("c", revision=before[1].revision, address=address),))
    assert (new.spec("rob"), new.spec("c")) == before
    assert (robots.arrived, containers.arrived) == ("r1", "c1")
    assert (new.session(), new.phase()) == ("connected", "running")


def test_a_store_from_an_old_copy_goes_on_above_what_was_applied(world: World) -> None:
    """Between the copy and the restart, the former master gave revisions up to 400."""
    world.wired()
    new = restarted(world, revision=500)
    new.container_set(endpoints=(status("c", revision=400),))
    assert new.spec("c").revision > 500


@pytest.mark.parametrize("revision", [5000, 2**53, 2**63 - 1])
def test_revisions_that_nobody_gave_are_not_believed(world: World, revision: int) -> None:
    """Neither when a task set comes, nor in a report, whether the container is placed there or nowhere."""
    world.wired()
    world.run()
    newest = world.spec("c").revision
    world.leave("c1")
    changes = world.container_set(endpoints=(status("c", revision=revision),))
    assert "revision_unknown" in kinds(changes)
    world.report("c1", status("c", revision=revision))
    world.robot_set(endpoints=(status("rob", revision=revision),))
    world.node("c", "n")
    assert newest < world.spec("c").revision < newest + 20
    world.leave("c1")
    world.tick(30)
    assert world.phase() == "lost"
    world.container_set(endpoints=(status("c", revision=revision),))
    assert world.phase() == "lost", "what claims such a revision is not taken for a life of the container"
    world.state.validate()


def test_robots_that_do_not_come_back_after_a_restart_expire(world: World) -> None:
    world.wired()
    new = restarted(world)
    new.tick(60)
    assert new.state.tables.robots() == []
    assert new.phase() == "lost"


@pytest.mark.parametrize("name", ["", "a b", "x" * 256, "a\n"])
def test_a_task_set_without_a_usable_name_is_refused(world: World, name: str) -> None:
    with pytest.raises(InvalidRequestError, match="names no task set"):
        world.robot_set(name)
    world.robot_set("r1")
    with pytest.raises(ConflictError, match="there is a robot task set 'r1' already"):
        world.container_set("r1")


def test_nodes_that_start_again_are_events(world: World) -> None:
    world.wired()
    world.node("c", "n")
    world.run(nodes=(NodeStatus(tag="n", state=NodeState.RUNNING, pid=1),))
    waiting = NodeStatus(tag="n", state=NodeState.WAITING, restarts=0, detail="starts again in 1 s")
    degraded = world.report("c1", status("c", EndpointState.DEGRADED, nodes=(waiting,)))
    assert kinds(degraded) == ["container_degraded", "node_waiting"]
    assert world.phase() == "degraded"
    again = world.run(nodes=(NodeStatus(tag="n", state=NodeState.RUNNING, pid=2, restarts=1),))
    assert [(h.kind, h.text) for h in again.events] == [
        ("container_running", ""),
        ("node_restarted", "for the 1st time"),
        ("node_running", ""),
    ]
    stuck = world.run(nodes=(NodeStatus(tag="n", state=NodeState.STUCK, pid=2, restarts=1),))
    assert kinds(stuck) == ["node_stuck"]


def test_container_ended_by_machine_waits_for_another(world: World) -> None:
    """A container that its machine ended is stopped until there is another."""
    world.wired()
    world.do(commands.SetDraining(machine="c1", draining=True))
    world.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert world.phase() == "stopped"
    world.container_set("c2")
    assert world.phase() == "placed"


def test_earlier_container_of_same_name_is_another_one() -> None:
    """A container of the same name that ran before is not taken for this one."""
    world = World()
    world.container_set("c1")
    world.container("c")
    former = EndpointStatus(
        id="anna/c", revision=world.spec("c").revision, state=EndpointState.RUNNING, incarnation="former"
    )
    world.report("c1", former)
    world.do(commands.TaskSetLeft(process="c1"))
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    world.container("c")
    world.container_set("c1", endpoints=(former,))
    assert world.state.tables.endpoints["anna/c"].task_set == "", "the former one has to end first"
    world.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert world.state.tables.endpoints["anna/c"].task_set == "c1"
