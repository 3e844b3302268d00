"""Machines that are emptied: containers are handed over, one by one, without a gap."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from support.master_world import World
from support.moves import at, drain, kinds, move, moves, report

from rce.control.model import EndpointState, EndpointStatus, NodeState, NodeStatus
from rce.model.specs import ResourceChanges
from rce_master.exceptions import ConflictError, NoRoomError, NotFoundError
from rce_master.state import commands
from rce_master.state.core import State


@pytest.fixture
def two() -> World:
    """Two containers at machine m1, one of them joined with a robot, and an empty machine m2."""
    world = World()
    world.robot_set()
    world.container_set("c1", name="m1", slots=4)
    world.login()
    for tag in ("c", "d"):
        world.container(tag)
        report(world, tag, "c1")
    world.node("c", "n")
    world.interface("rob/out", "SubscriberConverter")
    world.interface("c/in", "PublisherInterface")
    world.connect("rob/out", "c/in")
    world.container_set("c2", name="m2", slots=4)
    return world


def test_a_copy_without_its_spec_does_not_take_over(two: World) -> None:
    """Its environment runs, and has yet to be told of its nodes."""
    two.node("d", "n")
    two.do(commands.MoveContainer(user="anna", tag="d", machine="m2"))
    status = EndpointStatus(id="anna/d", revision=0, state=EndpointState.RUNNING)
    two.report("c2", status)
    assert at(two, "d") == "c1"
    two.report("c2", replace(status, revision=1))
    assert at(two, "d") == "c2"


def test_a_copy_is_made_first_and_takes_over_when_it_is_up(two: World) -> None:
    changes = drain(two)
    assert moves(two) == {"c": "c2"}, "one at a time"
    assert at(two, "c") == "c1"
    assert "anna/c" in changes.touched
    process, copy = two.state.copy_spec("anna/c") or ("", None)
    assert process == "c2"
    assert copy is not None
    assert ([node.tag for node in copy.nodes], copy.interfaces, copy.links, copy.connections) == (
        ["n"],
        (),
        (),
        (),
    )
    starting = (NodeStatus(tag="n", state=NodeState.STARTING),)
    assert report(two, "c", "c2", nodes=starting).withdrawals == []
    assert at(two, "c") == "c1", "its node is not up yet"
    assert two.spec("rob").links[0].address.unix == "/c1/c"
    before = two.spec("c").revision
    changes = report(two, "c", "c2", nodes=(NodeStatus(tag="n", state=NodeState.RUNNING),))
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c1", "anna/c")]
    assert (at(two, "c"), two.phase("c")) == ("c2", "running")
    assert two.spec("c").revision > before
    assert len(two.spec("c").connections) == 1
    assert two.spec("rob").links[0].address.unix == "/c2/c"
    assert {"anna/c", "anna/rob"} <= set(changes.touched)
    assert moves(two) == {"d": "c2"}, "then the next"
    report(two, "d", "c2")
    assert (at(two, "d"), moves(two)) == ("c2", {})


def established(world: World) -> tuple[int, ...]:
    """Let the robot and its container report their connection as established."""
    (number,) = (connection.id for connection in world.spec("c").connections)
    running = NodeStatus(tag="n", state=NodeState.RUNNING)
    report(world, "c", "c1", nodes=(running,), connections=(number,))
    status = EndpointStatus(id="anna/rob", revision=1, state=EndpointState.RUNNING, connections=(number,))
    world.report("r1", status)
    return (number,)


def test_links_are_made_before_they_are_broken(two: World) -> None:
    """The robot gets the copy's address beside the container's; the copy takes over when it is linked."""
    numbers = established(two)
    drain(two)
    nodes = (NodeStatus(tag="n", state=NodeState.RUNNING),)
    changes = report(two, "c", "c2", nodes=nodes)
    assert (at(two, "c"), changes.withdrawals) == ("c1", [])
    assert {"anna/c", "anna/rob"} <= set(changes.touched)
    (link,) = two.spec("rob").links
    assert link.next is not None
    assert (link.address.unix, link.next.unix) == ("/c1/c", "/c2/c")
    _, copy = two.state.copy_spec("anna/c") or ("", None)
    assert copy is not None
    assert [one.copy for one in copy.links] == [True]
    assert [one.id for one in copy.connections] == [*numbers]
    changes = report(two, "c", "c2", nodes=nodes, connections=numbers)
    assert (at(two, "c"), changes.withdrawals) == ("c2", []), "the former one still answers"
    (link,) = two.spec("rob").links
    assert (link.address.unix, link.next) == ("/c2/c", None)
    assert [one.copy for one in two.spec("c").links] == [False]
    assert changes.wanted_statuses == [("c2", "anna/c")]
    changes = report(two, "c", "c1", nodes=nodes)
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c1", "anna/c")], "after its last answers"
    two.state.validate()


def test_a_copy_without_links_takes_over_after_a_while(two: World) -> None:
    """A robot of an earlier release does not link to the copy; the former container has its time, too."""
    established(two)
    drain(two)
    nodes = (NodeStatus(tag="n", state=NodeState.RUNNING),)
    report(two, "c", "c2", nodes=nodes)
    assert two.tick(9.0).withdrawals == []
    assert at(two, "c") == "c1"
    two.tick(2.0)
    assert at(two, "c") == "c2"
    assert two.tick(14.0).withdrawals == []
    assert [(w.process, w.id) for w in two.tick(2.0).withdrawals] == [("c1", "anna/c")]


def test_a_move_that_is_given_up_takes_the_copy_s_address_back(two: World) -> None:
    """The target dies while the links are made: the robot keeps its link to the container."""
    established(two)
    drain(two)
    report(two, "c", "c2", nodes=(NodeStatus(tag="n", state=NodeState.RUNNING),))
    changes = two.leave("c2")
    (link,) = two.spec("rob").links
    assert (link.address.unix, link.next, at(two, "c")) == ("/c1/c", None, "c1")
    assert "anna/rob" in changes.touched


def test_a_container_that_ends_while_links_are_made_is_replaced(two: World) -> None:
    """Its copy takes over at once, at the address that the robot has linked to already."""
    established(two)
    drain(two)
    report(two, "c", "c2", nodes=(NodeStatus(tag="n", state=NodeState.RUNNING),))
    two.do(commands.EndpointGone(process="c1", id="anna/c"))
    (link,) = two.spec("rob").links
    assert (link.address.unix, link.next, at(two, "c")) == ("/c2/c", None, "c2")


def test_a_copy_need_not_be_better_than_the_container(two: World) -> None:
    two.node("c", "silent")
    running, starting = NodeState.RUNNING, NodeState.STARTING

    def nodes(n: NodeState, silent: NodeState) -> tuple[NodeStatus, ...]:
        return NodeStatus(tag="n", state=n), NodeStatus(tag="silent", state=silent)

    report(two, "c", "c1", nodes=nodes(running, starting))
    drain(two)
    report(two, "c", "c2", nodes=nodes(starting, starting))
    assert at(two, "c") == "c1", "n is not up yet"
    report(two, "c", "c2", nodes=nodes(running, starting))
    assert at(two, "c") == "c2", "a node that is none of ROS never registers, there neither"


def test_a_draining_machine_takes_nothing_new(two: World) -> None:
    drain(two)
    two.container("new")
    assert at(two, "new") == "c2"
    drain(two, "c2")
    with pytest.raises(NoRoomError, match="m1 is draining; m2 is draining"):
        two.container("newer")
    drain(two, "m1", undo=True)
    two.container("newer")
    assert at(two, "newer") == "c1"
    with pytest.raises(NotFoundError, match="there is no machine or task set 'm3'"):
        drain(two, "m3")


def test_unplaceable_container_stays_operator_told_once(two: World) -> None:
    """What has room nowhere stays and the operator is told once."""
    two.container("large", size=4)
    assert at(two, "large") == "c2"
    changes = drain(two)
    (first, second) = [h for h in changes.events if h.kind == "container_stays"]
    assert (first.subject, first.user) == ("anna/c", "")
    assert "m2 has 0 of 4 slots free, 1 needed" in first.text
    assert second.subject == "anna/d"
    assert moves(two) == {}
    assert kinds(two.tick(1)) == []
    two.do(commands.DestroyContainer(user="anna", tag="large"))
    two.do(commands.EndpointGone(process="c2", id="anna/large"))
    assert moves(two) == {"c": "c2"}


def test_a_copy_that_fails_is_dropped_and_tried_again_later(two: World) -> None:
    drain(two)
    changes = report(two, "c", "c2", EndpointState.FAILED, detail="no such package")
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c2", "anna/c")]
    stays = [h.text for h in changes.events if h.kind == "container_stays"]
    assert "failed there: no such package" in stays[0]
    assert at(two, "c") == "c1"
    two.do(commands.EndpointGone(process="c2", id="anna/c"))
    assert moves(two) == {"d": "c2"}, "the others go on"
    report(two, "d", "c2")
    assert moves(two) == {}
    two.tick(30)
    assert moves(two) == {"c": "c2"}
    changes = two.tick(60)
    assert "did not come up there within 60 s" in changes.events[0].text


def test_a_copy_waits_until_its_former_one_is_gone_there(two: World) -> None:
    drain(two)
    report(two, "c", "c2")
    drain(two, "m1", undo=True)
    drain(two, "m2")
    assert moves(two) == {}, "the former c still ends at m1"
    two.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert moves(two) == {"c": "c1"}


def test_undoing_calls_what_is_on_its_way_back(two: World) -> None:
    drain(two)
    changes = drain(two, undo=True)
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c2", "anna/c")]
    assert (moves(two), at(two, "c")) == ({}, "c1")
    assert kinds(drain(two, undo=True)) == []


def test_a_container_that_is_destroyed_takes_its_copy_along(two: World) -> None:
    drain(two)
    changes = two.do(commands.DestroyContainer(user="anna", tag="c"))
    assert {(w.process, w.id) for w in changes.withdrawals} == {("c1", "anna/c"), ("c2", "anna/c")}


def test_machine_shut_down_midway_leaves_the_copy(two: World) -> None:
    """A machine that is shut down meanwhile leaves what moves to its copy."""
    drain(two)
    two.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert (at(two, "c"), two.phase("c")) == ("c2", "placed")
    report(two, "c", "c2")
    assert two.phase("c") == "running"
    two.leave("c1")
    two.tick(30)
    assert at(two, "d") == "c2"


def test_a_target_that_goes_away_ends_the_move(two: World) -> None:
    drain(two)
    two.leave("c2")
    assert (moves(two), at(two, "c")) == ({}, "c1")
    status = EndpointStatus(id="anna/c", revision=9, state=EndpointState.RUNNING)
    two.container_set("c2", name="m2", slots=4, endpoints=(status,))
    assert at(two, "c") == "c1"


def test_a_copy_that_is_as_degraded_as_its_original_takes_over(two: World) -> None:
    drain(two)
    report(two, "c", "c2", EndpointState.DEGRADED)
    assert at(two, "c") == "c1"
    report(two, "c", "c1", EndpointState.DEGRADED)
    report(two, "c", "c2", EndpointState.DEGRADED)
    assert (at(two, "c"), two.phase("c")) == ("c2", "degraded")


def test_copies_count_where_they_are_made(two: World) -> None:
    two.container("large", size=3)
    drain(two)
    assert moves(two) == {"c": "c2"}
    with pytest.raises(NoRoomError, match="m2 has 0 of 4 slots free"):
        two.container("more")
    with pytest.raises(NoRoomError, match="m2 has 1 of 4 slots free, 2 needed"):
        two.do(commands.ResizeContainer(user="anna", tag="c", changes=ResourceChanges(size=2)))


def test_a_drain_outlives_a_restart_of_the_master(two: World) -> None:
    drain(two)
    snapshot = {
        table.name: {table.key(r): table.encode(r) for r in table}
        for table in two.state.tables.all
        if table.persistent
    }
    two.state = State.load(snapshot, two.now)
    two.state.validate()
    running = tuple(EndpointStatus(id=f"anna/{tag}", revision=1, state=EndpointState.RUNNING) for tag in "cd")
    two.container_set("c2", name="m2", slots=4, endpoints=running[:1])
    two.container_set("c1", name="m1", slots=4, endpoints=running)
    two.tick(1)
    assert moves(two) == {"c": "c2"}


def test_a_machine_may_say_itself_that_it_drains(two: World) -> None:
    running = tuple(EndpointStatus(id=f"anna/{tag}", revision=1, state=EndpointState.RUNNING) for tag in "cd")
    two.leave("c1")
    two.container_set("c1", name="m1", slots=4, draining=True, endpoints=running)
    two.tick(1)
    assert moves(two) == {"c": "c2"}
    two.container("new")
    assert at(two, "new") == "c2"


def test_one_container_is_handed_over_and_the_machine_keeps_the_others(two: World) -> None:
    assert kinds(move(two)) == ["container_moving"]
    assert moves(two) == {"c": "c2"}
    changes = report(two, "c", "c2")
    assert "container_moved" in kinds(changes)
    assert (at(two, "c"), at(two, "d"), moves(two)) == ("c2", "c1", {})
    two.container("new")
    assert at(two, "new") in {"c1", "c2"}, "neither of them is draining"
    with pytest.raises(NoRoomError, match="a container of its name is still ending there"):
        move(two, machine="c1")
    two.do(commands.EndpointGone(process="c1", id="anna/c"))
    move(two, machine="c1")
    assert moves(two) == {"c": "c1"}, "back again, by the name of the task set"


def test_what_cannot_be_moved_is_said(two: World) -> None:
    with pytest.raises(NotFoundError, match="no container 'none'"):
        move(two, "none")
    with pytest.raises(NotFoundError, match="no container machine 'm9'"):
        move(two, machine="m9")
    with pytest.raises(ConflictError, match="is at m1 already"):
        move(two, machine="m1")
    move(two)
    with pytest.raises(ConflictError, match="moves to c2 already"):
        move(two)
    two.do(commands.ResizeContainer(user="anna", tag="d", changes=ResourceChanges(size=3)))
    two.container_set("c3", name="m3", slots=2)
    with pytest.raises(NoRoomError, match="container 'd' stays: m3 has 2 of 2 slots free"):
        move(two, "d", "m3")
    drain(two, "m3")
    with pytest.raises(NoRoomError, match="m3 is draining"):
        move(two, "d", "m3")


def test_a_move_that_fails_is_not_tried_again(two: World) -> None:
    move(two)
    changes = report(two, "c", "c2", EndpointState.FAILED, detail="no such image")
    assert [event.text for event in changes.events if event.kind == "container_stays"] == [
        "at c1: c2: it failed there: no such image"
    ]
    two.do(commands.Tick())
    assert (at(two, "c"), moves(two)) == ("c1", {})
