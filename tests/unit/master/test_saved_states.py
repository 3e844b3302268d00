"""Saved states of nodes in the master's state: whose snapshots count, and what they take."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace
from support.master_world import World

from rce.control.model import EndpointState, EndpointStatus
from rce.model import MAX_STATE, MEGABYTE, NodeSpec, StateServices
from rce_master.exceptions import ConflictError, InvalidRequestError, LimitReachedError, NotFoundError
from rce_master.state import commands, saved_states
from rce_master.state.core import State
from rce_master.state.limits import used_of
from rce_master.state.volume_records import SavedState

SERVICES = StateServices(save="save", restore="restore")
FIRST = SavedState(
    container="anna/c",
    node="n",
    process="c1",
    incarnation="one",
    number=1,
    size=MEGABYTE,
    sha256="a" * 64,
    taken=5.0,
)


@pytest.fixture
def world() -> World:
    """A container with a node whose state is kept, and one whose state is not, and a second machine."""
    made = World()
    made.container_set("c1", name="m1", slots=4)
    made.container()
    made.container_set("c2", name="m2", slots=4)
    for tag, services in (("n", SERVICES), ("plain", None)):
        node = NodeSpec(tag=tag, pkg="Test", exe="run.py", state_services=services)
        made.do(commands.AddNode(user="anna", container="c", node=node))
    made.run(incarnation="one")
    return made


def save(world: World, **changes: Any) -> None:
    world.do(commands.SaveState(state=replace(FIRST, **changes)))


def kept(world: World) -> list[tuple[str, int]]:
    return [(state.incarnation, state.number) for state in world.state.tables.saved_states]


def refusal(world: World, error: type[Exception], **changes: Any) -> str:
    with pytest.raises(error) as caught:
        save(world, **changes)
    return str(caught.value)


def test_the_newest_snapshot_takes_the_place_of_others(world: World) -> None:
    save(world)
    save(world, number=3, sha256="b" * 64)
    assert "newer" in refusal(world, ConflictError, number=2)
    assert "newer" in refusal(world, ConflictError, number=3)
    assert kept(world) == [("one", 3)]


def test_only_the_present_incarnation_counts(world: World) -> None:
    save(world, number=9)
    world.run(incarnation="two")
    assert "somewhere else" in refusal(world, ConflictError, number=10)
    save(world, incarnation="two", number=1)
    assert kept(world) == [("two", 1)]


def test_a_machine_that_lost_its_container_saves_it_no_more(world: World) -> None:
    """It is cut off, saves on, and comes back: the container went on from the snapshot before."""
    save(world)
    world.leave("c1")
    world.tick(100)
    assert world.state.tables.endpoints["anna/c"].task_set == "c2"
    refusal(world, ConflictError, number=2)
    world.run("c", "c2", incarnation="three")
    save(world, process="c2", incarnation="three")
    world.container_set("c1", name="m1", slots=4)
    refusal(world, ConflictError, number=2)
    assert kept(world) == [("three", 1)]


def test_a_copy_reads_and_does_not_save_until_it_took_over(world: World) -> None:
    save(world)
    world.do(commands.MoveContainer(user="anna", tag="c", machine="m2"))
    tables = world.state.tables
    assert saved_states.is_moving_to(tables, "anna/c", "c2")
    assert saved_states.find(tables, "c2", "anna/c", "n") == FIRST
    copy = EndpointStatus(id="anna/c", revision=1, state=EndpointState.STARTING, incarnation="copy")
    world.report("c2", copy)
    refusal(world, ConflictError, process="c2", incarnation="copy")
    save(world, number=2)
    world.report("c2", replace(copy, state=EndpointState.RUNNING))
    assert tables.endpoints["anna/c"].task_set == "c2"
    refusal(world, ConflictError, number=3)
    save(world, process="c2", incarnation="copy")


def test_other_machines_do_not_read_it(world: World) -> None:
    save(world)
    with pytest.raises(ConflictError):
        saved_states.find(world.state.tables, "c2", "anna/c", "n")
    with pytest.raises(NotFoundError):
        saved_states.find(world.state.tables, "c1", "anna/other", "n")
    assert saved_states.find(world.state.tables, "c1", "anna/c", "plain") is None


def test_snapshots_without_a_place_are_refused(world: World) -> None:
    assert "no node 'plain' whose state" in refusal(world, NotFoundError, node="plain")
    assert "no node 'x' whose state" in refusal(world, NotFoundError, node="x")
    assert "no container" in refusal(world, NotFoundError, container="anna/x")
    assert "larger than 16 MB" in refusal(world, InvalidRequestError, size=MAX_STATE + 1)


def test_they_count_as_disk(world: World) -> None:
    world.do(commands.SetLimits(user="anna", limits={"disk": 3.0 * MEGABYTE}))
    save(world)
    assert used_of(world.state.tables, "anna")["disk"] == MEGABYTE
    save(world, number=2, size=3 * MEGABYTE)
    assert "rce user limit anna --disk" in refusal(world, LimitReachedError, number=3, size=3 * MEGABYTE + 1)
    save(world, number=4, size=MEGABYTE)
    world.do(commands.SetLimits(user="anna", limits={"disk": 1.0}))
    save(world, number=5, size=MEGABYTE)
    refusal(world, LimitReachedError, number=6, size=MEGABYTE + 1)


def test_they_end_with_the_container_and_not_with_the_node(world: World) -> None:
    save(world)
    world.do(commands.RemoveNode(user="anna", container="c", tag="n"))
    assert kept(world) == [("one", 1)]
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    assert kept(world) == []


def test_they_are_removed_on_request(world: World) -> None:
    save(world)
    remove = commands.RemoveState(user="anna", container="c", node="n")
    world.do(remove)
    assert kept(world) == []
    with pytest.raises(NotFoundError, match="rce state list"):
        world.do(remove)


def test_they_end_with_their_user(world: World) -> None:
    save(world)
    world.do(commands.RemoveUser(name="anna"))
    assert kept(world) == []


def test_they_are_stored(world: World) -> None:
    save(world)
    tables = world.state.tables
    rows = {
        table.name: {table.key(r): table.encode(r) for r in table} for table in tables.all if table.persistent
    }
    assert list(State.load(rows, 0.0).tables.saved_states) == [FIRST]
