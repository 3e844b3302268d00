"""Epochs: by them a container's peers tell its place from those that it has left."""

from __future__ import annotations

import pytest
from support.master_world import World, restarted

from rce.control.model import EndpointState, EndpointStatus, LinkAddress, LinkSpec, NodeState, NodeStatus
from rce.model.specs import Network
from rce_master.state import commands

RUNNING = (NodeStatus(tag="n", state=NodeState.RUNNING),)


def report(world: World, tag: str, process: str, connections: tuple[int, ...] = ()) -> None:
    world.report(
        process,
        EndpointStatus(
            id=f"anna/{tag}",
            revision=1,
            state=EndpointState.RUNNING,
            address=LinkAddress(machine=process, unix=f"/{process}/{tag}"),
            nodes=RUNNING if tag == "a" else (),
            connections=connections,
        ),
    )


def at(world: World, tag: str) -> str:
    return world.state.tables.endpoints[f"anna/{tag}"].task_set


def link(world: World, tag: str) -> LinkSpec:
    (found,) = world.spec(tag).links
    return found


def copy_link(world: World) -> LinkSpec:
    _, copy = world.state.copy_spec("anna/a") or ("", None)
    assert copy is not None
    (found,) = copy.links
    return found


def agree(world: World) -> int:
    """Check that the ends of the link know the same epoch, and return it."""
    assert link(world, "a").dial
    assert (link(world, "a").peer_epoch, link(world, "b").epoch) == (0, 0), "each end has what it needs"
    assert link(world, "a").epoch == link(world, "b").peer_epoch > 0
    return link(world, "a").epoch


def begin_move(world: World) -> int:
    """Let a's copy at m3 make its links, beside the established ones; return the connection."""
    (number,) = (one.id for one in world.spec("a").connections)
    report(world, "a", "c1", (number,))
    report(world, "b", "c2", (number,))
    world.do(commands.MoveContainer(user="anna", tag="a", machine="m3"))
    report(world, "a", "c3")
    return number


@pytest.fixture
def pair() -> World:
    """Container a at machine m1 and b at m2, which it dials, and an empty machine m3."""
    world = World()
    world.container_set("c1", name="m1", slots=1)
    world.container("a")
    world.node("a", "n")
    world.container_set("c2", name="m2", slots=1)
    world.container("b")
    world.interface("a/out", "SubscriberInterface")
    world.interface("b/in", "PublisherInterface")
    world.connect("a/out", "b/in")
    report(world, "a", "c1")
    report(world, "b", "c2")
    assert (at(world, "a"), at(world, "b")) == ("c1", "c2")
    world.container_set("c3", name="m3", slots=4)
    return world


def test_container_made_elsewhere_has_a_greater_epoch(pair: World) -> None:
    former = agree(pair)
    pair.leave("c1")
    changes = pair.tick(30)
    assert at(pair, "a") == "c3"
    assert agree(pair) > former
    assert list(changes.touched["anna/b"].links) == [link(pair, "b").id]


def test_accepting_container_made_elsewhere_tells_its_peer_nothing(pair: World) -> None:
    """The peer dials its new address; the former one hears nothing more of it."""
    former = agree(pair)
    pair.container_set("c4", name="m4", slots=1)
    pair.leave("c2")
    changes = pair.tick(30)
    assert at(pair, "b") in ("c3", "c4")
    assert agree(pair) == former
    assert "anna/b" in changes.touched


def test_copy_has_the_epoch_that_its_container_will_have(pair: World) -> None:
    former = agree(pair)
    number = begin_move(pair)
    copy = copy_link(pair)
    assert agree(pair) == former < copy.epoch, "the present place is not refused before the copy takes over"
    report(pair, "a", "c3", (number,))
    assert at(pair, "a") == "c3"
    assert agree(pair) == copy.epoch


def test_each_copy_has_an_epoch_of_its_own(pair: World) -> None:
    """One that was given up, and is cut off, is not taken for the next one."""
    begin_move(pair)
    first = copy_link(pair)
    pair.leave("c3")
    pair.container_set("c4", name="m4", slots=4)
    pair.tick(pair.state.settings.move_rest + 1)
    pair.do(commands.MoveContainer(user="anna", tag="a", machine="m4"))
    report(pair, "a", "c4")
    assert copy_link(pair).epoch > first.epoch > agree(pair)


def test_epochs_grow_above_those_that_a_restored_backup_forgot(pair: World) -> None:
    """They continue above the clock at the restart, as revisions do."""
    agree(pair)
    world = restarted(pair, revision=500)
    world.container_set("c2", name="m2", slots=1)
    world.container_set("c3", name="m3", slots=4)
    world.tick(30)
    assert at(world, "a") == "c3"
    assert agree(world) > 500


def test_group_whose_copies_replace_it_is_lost_as_a_whole_or_not() -> None:
    """The machine goes while two containers of a group are moved: both are at the new one then."""
    world = World()
    for number in (1, 2):
        world.container_set(f"c{number}", name=f"m{number}", slots=4, networks=("none", "group"))
    for tag in "ab":
        world.container(tag, network=Network.GROUP, group="g")
        world.report("c1", EndpointStatus(id=f"anna/{tag}", revision=1, state=EndpointState.RUNNING))
    world.do(commands.MoveContainer(user="anna", tag="a", machine="m2"))
    assert len(world.state.tables.moves) == 2
    world.leave("c1")
    changes = world.tick(30)
    assert [at(world, tag) for tag in "ab"] == ["c2", "c2"]
    assert [event.kind for event in changes.events].count("container_lost") == 0
    assert [(one.process, one.id) for one in changes.withdrawals] == []
