"""The order in which a container's nodes start and end."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.node_world import World, spec

from rce.control.model import NodeState, NodeStatus
from rce.model.specs import NodeSpec
from rce_container.environment.nodes.order import StartOrder, levels, ready_to_end


def test_a_node_waits_until_those_before_it_are_ready() -> None:
    world = World(spec("c", after=("a", "b")), spec("a"), spec("b"))
    assert world.launched == ["a", "b"]
    assert world.status("c").detail == "waits for a (not registered yet), b (not registered yet)"
    world.register("a")
    assert world.status("c").detail == "waits for b (not registered yet)"
    world.end("b", code=0)
    assert world.launched == ["a", "b", "c"], "registered, or ended with exit code 0"


def test_a_node_waits_for_one_that_failed_and_says_so() -> None:
    world = World(spec("a"), spec("b", after=("a",)))
    world.end("a")
    assert world.status("b") == NodeStatus(tag="b", state=NodeState.WAITING, detail="waits for a (failed)")
    world.desire(spec("a", args="better"), spec("b", after=("a",)))
    world.register("a")
    assert world.status("b").state is NodeState.STARTING


@pytest.mark.parametrize(
    ("specs", "faults"),
    [
        (
            [spec("a", after=("x",))],
            ["node a waits for 'x', which the container does not have; add it, or change 'after'"],
        ),
        (
            [spec("a", after=("a",))],
            ["node a waits for itself (a after a); change 'after' of one of them"],
        ),
        (
            [spec("a", after=("b",)), spec("b", after=("c",)), spec("c", after=("a",))],
            [
                "node a waits for itself (a after b after c after a); change 'after' of one of them",
                "node b waits for itself (b after c after a after b); change 'after' of one of them",
                "node c waits for itself (c after a after b after c); change 'after' of one of them",
            ],
        ),
    ],
)
def test_an_impossible_order_is_told_once_and_can_be_mended(specs: list[NodeSpec], faults: list[str]) -> None:
    world = World(*specs)
    assert world.told == faults
    assert set(world.states().values()) == {NodeState.WAITING}
    assert f"node a {world.status().detail}" == faults[0]
    world.desire(*specs, spec("other"))
    assert world.told == faults
    assert world.launched == ["other"]
    world.desire(spec("a"), *specs[1:], spec("x"))
    assert "a" in world.launched


def test_nodes_end_in_reverse_order() -> None:
    """Nodes end in the reverse of their order and together where there is none."""
    world = World(spec("a"), spec("b", after=("a",)), spec("c", after=("a",)), spec("d", after=("b", "c")))
    for tag in "abcd":
        world.register(tag)
    world.desire()
    assert world.halting == {"d": pytest.approx(1 / 3)}
    world.end("d")
    assert set(world.halting) == {"b", "c"}
    world.end("c")
    assert set(world.halting) == {"b"}
    world.end("b")
    assert world.halting == {"a": pytest.approx(1 / 3)}
    world.end("a")
    assert world.states() == {}
    assert world.told == []


def test_nodes_whose_order_became_a_circle_end_all_the_same() -> None:
    world = World(spec("a"), spec("b", after=("a",)))
    world.register("a")
    world.register("b")
    world.desire(spec("a", after=("b",)), spec("b", after=("a",)))
    assert not world.halting
    world.desire()
    assert set(world.halting) == {"a", "b"}


SPECS = st.lists(
    st.builds(
        lambda tag, before: spec(tag, after=tuple(sorted(before))),
        st.sampled_from("abcdef"),
        st.sets(st.sampled_from("abcdef"), max_size=3),
    ),
    unique_by=lambda one: one.tag,
    max_size=6,
)


@given(SPECS)
def test_what_is_not_at_fault_can_start_and_everything_can_end(specs: list[NodeSpec]) -> None:
    faults = StartOrder(specs).faults()
    by_tag = {one.tag: one for one in specs}
    started: set[str] = set()
    while new := {tag for tag, one in by_tag.items() if set(one.after) <= started} - started:
        started |= new
    assert not started & set(faults)
    behind = set(by_tag) - started - set(faults)
    assert all(set(by_tag[tag].after) & (set(faults) | behind) for tag in behind)
    leaving = {tag: one.after for tag, one in by_tag.items()}
    rounds = levels(leaving)
    while leaving:
        turn = ready_to_end(leaving)
        assert turn
        leaving = {tag: befores for tag, befores in leaving.items() if tag not in turn}
        rounds -= 1
    assert rounds == 0
