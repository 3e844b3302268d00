"""What holds for a container's nodes after any events in any order."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.node_world import World, spec

from rce.control.model import NodeState
from rce.lifecycle import InvalidTransitionError
from rce.model.specs import RestartPolicy
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.life import NODE_LIFE, WITH_PROCESS, LifeEvent
from rce_container.environment.nodes.record import WELL_S


def test_the_table_knows_every_state_and_leads_out_of_each() -> None:
    assert set(NODE_LIFE.table) == set(NodeState)
    for state in NodeState:
        impossible = next(one for one in LifeEvent if not NODE_LIFE.allows(state, one))
        with pytest.raises(InvalidTransitionError, match=f"node is {state.value}"):
            NODE_LIFE.advance(state, impossible)
        assert NODE_LIFE.table[state]
    assert {state.value for state in WITH_PROCESS} == {"starting", "running", "stuck", "stopping"}


VARIANTS = st.builds(
    lambda tag, before, restart, limit, args, heartbeat: spec(
        tag,
        after=tuple(sorted(before - {tag})),
        restart=restart,
        max_restarts=limit,
        args=args,
        heartbeat=heartbeat,
        heartbeat_timeout=1.0,
    ),
    st.sampled_from("abc"),
    st.sets(st.sampled_from("abc"), max_size=1),
    st.sampled_from(RestartPolicy),
    st.integers(0, 2),
    st.sampled_from(["", "x"]),
    st.sampled_from(["", "/beat"]),
)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("desire"), st.lists(VARIANTS, max_size=3, unique_by=lambda one: one.tag)),
        st.tuples(
            st.sampled_from(["made", "register", "end well", "end badly", "beat", "refuse", "fail to start"]),
            st.sampled_from("abc"),
        ),
        st.tuples(st.just("wait"), st.sampled_from([0.1, 0.6, 3.0, 31.0])),
    ),
    max_size=60,
)


ACTIONS: dict[str, Callable[[World, str], None]] = {
    "made": World.made,
    "register": World.register,
    "end well": lambda world, tag: world.end(tag, 0),
    "end badly": lambda world, tag: world.end(tag, 3),
    "refuse": lambda world, tag: world.refuse(tag),
    "fail to start": lambda world, tag: world.refuse(tag, hopeless=False),
}


@given(STEPS)
def test_any_order_of_events_keeps_the_promises(steps: Iterable[tuple[str, Any]]) -> None:
    """Never two processes, never before its turn (the world looks at that), and all can be ended."""
    world = World()
    for name, what in steps:
        if name == "desire":
            world.desire(*what)
        elif name == "wait":
            world.wait(what)
        elif name == "beat":
            world.do(e.Beat(what))
        elif what in world.alive:
            ACTIONS[name](world, what)
        states = world.states()
        assert {tag for tag, state in states.items() if state in WITH_PROCESS} == set(world.alive)
        assert set(states) == set(world.desired) | set(world.alive)
        for tag, one in world.desired.items():
            could = states[tag] is NodeState.WAITING and "starts again" not in world.status(tag).detail
            assert not could or one.after, "it waits for nothing"
    world.desire()
    for _ in range(3):
        for tag in list(world.halting):
            world.end(tag)
    assert world.states() == {}


@given(st.lists(st.sampled_from(["end", "wait"]), max_size=40), st.integers(1, 4))
def test_the_limit_of_restarts_is_never_exceeded(steps: list[str], limit: int) -> None:
    world = World(spec(restart=RestartPolicy.ALWAYS, max_restarts=limit))
    for step in steps:
        if step == "end" and world.alive:
            world.end()
        else:
            world.wait(8.0)
        assert world.status().restarts <= limit, "no life of these is long enough to count anew"
        if world.now > WELL_S:
            break
