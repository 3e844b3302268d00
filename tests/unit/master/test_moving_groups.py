"""Containers that share one group's network move as a whole, or stay as a whole."""

from __future__ import annotations

import pytest
from support.master_world import World
from support.moves import at, drain, move, moves, report

from rce.control.model import EndpointState, EndpointStatus
from rce.model import Volume
from rce.model.specs import Network
from rce_master.state import commands


def test_a_group_moves_as_a_whole(world: World) -> None:
    networks = ("none", "group")
    world.container_set("c1", name="m1", slots=4, networks=networks)
    for tag in "ab":
        world.container(tag, network=Network.GROUP, group="g")
        report(world, tag, "c1")
    world.container_set("c2", name="m2", slots=1, networks=networks)
    changes = drain(world)
    texts = [h.text for h in changes.events if h.kind == "container_stays"]
    assert "it moves with 1 others of its group; no machine has room for all of them" in texts[0]
    world.container_set("c3", name="m3", slots=2, networks=networks)
    world.tick(1)
    assert moves(world) == {"a": "c3", "b": "c3"}
    report(world, "a", "c3")
    assert at(world, "a") == "c1", "the whole group, or none of it"
    report(world, "b", "c3")
    assert (at(world, "a"), at(world, "b")) == ("c3", "c3")


@pytest.fixture
def grouped() -> World:
    """Containers a and b in the network of one group at machine m1, and two machines more."""
    world = World()
    for number in "123":
        world.container_set(f"c{number}", name=f"m{number}", slots=4, networks=("none", "group"))
    for tag in "ab":
        join_group(world, tag)
        report(world, tag, "c1")
    assert [at(world, tag) for tag in "ab"] == ["c1", "c1"]
    return world


def join_group(world: World, tag: str, *volumes: Volume) -> None:
    world.container(tag, network=Network.GROUP, group="g", volumes=volumes)


def test_a_group_stays_as_a_whole_if_one_fails(grouped: World) -> None:
    drain(grouped)
    (target,) = set(moves(grouped).values())
    changes = report(grouped, "b", target, EndpointState.FAILED, detail="no disk")
    assert {(w.process, w.id) for w in changes.withdrawals} == {(target, "anna/a"), (target, "anna/b")}
    texts = [event.text for event in changes.events if event.kind == "container_stays"]
    assert any("container 'b' of its group failed there: no disk" in text for text in texts)
    report(grouped, "a", target)
    assert [at(grouped, tag) for tag in "ab"] == ["c1", "c1"]
    grouped.tick(grouped.state.settings.move_rest + 1)
    assert set(moves(grouped)) == {"a", "b"}, "both are tried again"


def test_a_group_stays_as_a_whole_if_its_target_leaves(grouped: World) -> None:
    move(grouped, "a", "m2")
    grouped.leave("c2")
    assert moves(grouped) == {}
    assert [at(grouped, tag) for tag in "ab"] == ["c1", "c1"]


def test_a_group_stays_as_a_whole_if_one_is_late(grouped: World) -> None:
    move(grouped, "a", "m2")
    report(grouped, "a", "c2")
    grouped.tick(grouped.state.settings.move_timeout)
    assert moves(grouped) == {}
    assert [at(grouped, tag) for tag in "ab"] == ["c1", "c1"]


def test_who_joins_a_moving_group_moves_with_it(grouped: World) -> None:
    move(grouped, "a", "m2")
    join_group(grouped, "c")
    assert at(grouped, "c") == "c1", "its group is still there"
    report(grouped, "a", "c2")
    assert moves(grouped) == dict.fromkeys("abc", "c2")
    report(grouped, "b", "c2")
    assert at(grouped, "a") == "c1"
    report(grouped, "c", "c2")
    assert [at(grouped, tag) for tag in "abc"] == ["c2", "c2", "c2"]


def test_a_group_stays_if_who_joins_it_has_no_room_there(grouped: World) -> None:
    grouped.container_set("c4", name="m4", slots=2, networks=("none", "group"))
    move(grouped, "a", "m4")
    join_group(grouped, "c")
    changes = report(grouped, "a", "c4")
    assert moves(grouped) == {}
    texts = [event.text for event in changes.events]
    assert (
        "at c1: c4: it cannot move without container 'c', which joined its group: the machine lacks room"
        in texts
    )
    assert [at(grouped, tag) for tag in "abc"] == ["c1", "c1", "c1"]


def test_a_group_stays_if_who_joins_it_has_volumes(grouped: World) -> None:
    for number in "12":
        grouped.container_set(
            f"c{number}", name=f"m{number}", slots=4, networks=("none", "group"), volumes="image"
        )
    for tag in "ab":
        report(grouped, tag, "c1")
    move(grouped, "a", "m2")
    join_group(grouped, "c", Volume(name="v", path="/v", size=64 << 20))
    changes = report(grouped, "a", "c2")
    assert moves(grouped) == {}
    assert any("it cannot move without container 'c'" in event.text for event in changes.events)


def test_the_end_of_one_lets_all_copies_of_a_group_take_over(grouped: World) -> None:
    """Its machine shuts down: what is left of the group there ends, too."""
    move(grouped, "a", "m2")
    changes = grouped.do(commands.EndpointGone(process="c1", id="anna/a"))
    assert [at(grouped, tag) for tag in "ab"] == ["c2", "c2"]
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c1", "anna/b")]


def test_the_end_of_one_ends_the_move_of_a_group_without_all_copies(grouped: World) -> None:
    move(grouped, "a", "m2")
    join_group(grouped, "c")
    grouped.do(commands.EndpointGone(process="c1", id="anna/a"))
    assert moves(grouped) == {}
    assert [at(grouped, tag) for tag in "abc"] == ["c1", "c1", "c1"]


def test_a_lost_member_of_a_group_is_not_taken_back_elsewhere(grouped: World) -> None:
    """Of two at a lost machine, one found a place: the other one follows it, also if it still runs there."""
    grouped.leave("c3")
    grouped.container_set("c4", name="m4", slots=1, networks=("none", "group"))
    grouped.leave("c2")
    grouped.tick(grouped.state.settings.container_grace + 1)
    grouped.leave("c1")
    grouped.tick(grouped.state.settings.container_grace + 1)
    assert sorted(at(grouped, tag) for tag in "ab") == ["", "c4"]
    running = tuple(
        EndpointStatus(id=f"anna/{tag}", revision=grouped.spec(tag).revision, state=EndpointState.RUNNING)
        for tag in "ab"
    )
    grouped.container_set("c1", running, name="m1", slots=4, networks=("none", "group"))
    assert sorted(at(grouped, tag) for tag in "ab") == ["", "c4"]
