"""What is decided about a container's nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Unpack

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.parts import NodeLife

from rce.control.model import NodeState, NodeStatus
from rce.lifecycle import InvalidTransitionError
from rce.model.specs import NodeSpec, RestartPolicy
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.core import FIRST_BEAT_WITHIN_S, NodesCore
from rce_container.environment.nodes.life import NODE_LIFE, WITH_PROCESS, LifeEvent
from rce_container.environment.nodes.order import StartOrder, levels, ready_to_end
from rce_container.environment.nodes.record import LAST_CHANCE_S, WELL_S

FAILED = "exit code 3"


def spec(tag: str = "a", args: str = "", **life: Unpack[NodeLife]) -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe="x.py", args=args, **life)


class World:
    """A machine that does what the core says, at once or when a test wants it."""

    def __init__(self, *specs: NodeSpec) -> None:
        self.core = NodesCore()
        self.now = 0.0
        self.alive: dict[str, int] = {}
        """Lives that have a process, by tag."""
        self.halting: dict[str, float] = {}
        self.done: set[str] = set()
        """Nodes whose last life ended with exit code 0."""
        self.desired: dict[str, NodeSpec] = {}
        self.told: list[str] = []
        self.notes: list[str] = []
        self.launched: list[str] = []
        self.halted: list[str] = []
        self.desire(*specs)

    def do(self, event: e.Event) -> None:
        for one in self.core.handle(event, self.now):
            match one:
                case e.Launch(tag=tag, life=life):
                    assert tag not in self.alive, "two processes of a node"
                    states = self.states()
                    for before in self.desired[tag].after:
                        assert states[before] is NodeState.RUNNING or before in self.done, "before its turn"
                    self.done.discard(tag)
                    self.alive[tag] = life
                    self.launched.append(tag)
                case e.Halt(tag=tag, life=life, share=share):
                    assert self.alive[tag] == life
                    assert 0 < share <= 1
                    self.halting[tag] = share
                    self.halted.append(tag)
                case e.Tell(text=text):
                    self.told.append(text)
                case e.Note(text=text):
                    self.notes.append(text)
                case e.Forget(tag=tag):
                    assert tag not in self.alive
        self.core.validate()

    def desire(self, *specs: NodeSpec) -> None:
        self.desired = {one.tag: one for one in specs}
        self.done &= set(self.desired)
        self.do(e.Desire(specs))

    def made(self, tag: str = "a") -> None:
        self.do(e.Made(tag, self.alive[tag], 100 + self.alive[tag]))

    def register(self, tag: str = "a") -> None:
        self.do(e.Registered(tag, self.alive[tag]))

    def end(self, tag: str = "a", code: int = 3) -> None:
        life = self.alive.pop(tag)
        if code == 0 and tag not in self.halting:
            self.done.add(tag)
        self.halting.pop(tag, None)
        self.do(e.Ended(tag, life, code, f"exit code {code}"))

    def refuse(self, tag: str = "a", *, hopeless: bool = True) -> None:
        self.halting.pop(tag, None)
        self.do(e.Refused(tag, self.alive.pop(tag), "no package 'x'", hopeless))

    def wait(self, seconds: float) -> None:
        """Let time pass, with a tick at every deadline, as a timer would."""
        end = self.now + seconds
        for _ in range(10_000):
            if (deadline := self.core.deadline) > end:
                break
            self.now = max(self.now, deadline)
            self.do(e.Tick())
        else:
            raise AssertionError("ticks indefinitely")
        self.now = end

    def status(self, tag: str = "a") -> NodeStatus:
        return next(status for status in self.core.statuses if status.tag == tag)

    def states(self) -> dict[str, NodeState]:
        return {status.tag: status.state for status in self.core.statuses}


def test_a_node_is_started_registers_and_ends() -> None:
    world = World(spec())
    assert world.status().state is NodeState.STARTING
    world.made()
    assert world.status().pid == 101
    world.register()
    assert world.status() == NodeStatus(tag="a", state=NodeState.RUNNING, pid=101)
    world.end(code=0)
    assert world.status() == NodeStatus(tag="a", state=NodeState.EXITED, exit_code=0, detail="ended")
    assert (world.told, world.notes) == ([], ["ended: exit code 0"])
    assert not world.core.is_degraded


def test_a_node_that_fails_stays_so_by_default() -> None:
    world = World(spec())
    world.end()
    assert world.status() == NodeStatus(tag="a", state=NodeState.FAILED, exit_code=3, detail=FAILED)
    assert world.told == ["node a failed: exit code 3"]
    assert world.core.is_degraded
    world.wait(1000)
    assert world.launched == ["a"]


@pytest.mark.parametrize(
    ("policy", "code", "again"),
    [
        (RestartPolicy.NEVER, 0, False),
        (RestartPolicy.NEVER, 3, False),
        (RestartPolicy.ON_FAILURE, 0, False),
        (RestartPolicy.ON_FAILURE, -9, True),
        (RestartPolicy.ALWAYS, 0, True),
        (RestartPolicy.ALWAYS, 3, True),
    ],
)
def test_the_restart_policy(policy: RestartPolicy, code: int, again: bool) -> None:
    world = World(spec(restart=policy))
    world.end(code=code)
    if not again:
        assert world.status().state in (NodeState.EXITED, NodeState.FAILED)
        return
    status = world.status()
    assert (status.state, status.exit_code) == (NodeState.WAITING, code)
    assert status.detail.endswith("starts again after 0.5 s")
    assert world.core.is_degraded is (code != 0), "a pause after a proper end is not a failure"
    world.wait(0.4)
    assert not world.alive
    world.wait(0.1)
    assert world.alive
    assert (world.status().state, world.status().restarts) == (NodeState.STARTING, 1)
    assert not world.core.is_degraded


def test_pauses_grow_and_the_limit_ends_them() -> None:
    world = World(spec(restart=RestartPolicy.ON_FAILURE, max_restarts=9))
    pauses = []
    for _ in range(9):
        world.end()
        pauses.append(world.core.deadline - world.now)
        world.wait(pauses[-1])
    world.end()
    assert pauses == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    status = world.status()
    assert (status.state, status.restarts, status.exit_code) == (NodeState.FAILED, 9, 3)
    assert status.detail == (
        "exit code 3; it was started again 9 times in a row, which is its limit: "
        "to start it again, remove it and add it again, or change it"
    )
    assert world.told == [
        "node a failed: exit code 3; it is started again",
        f"node a failed: {status.detail}",
    ], "the user hears of the same failure once, and of the end of all tries"
    world.desire()
    world.desire(spec(restart=RestartPolicy.ON_FAILURE, max_restarts=9))
    assert (world.status().state, world.status().restarts) == (NodeState.STARTING, 0)


def test_without_a_limit_it_goes_on_for_ever() -> None:
    world = World(spec(restart=RestartPolicy.ALWAYS, max_restarts=0))
    for _ in range(50):
        world.end()
        world.wait(30)
    assert world.status().restarts == 50


def test_a_node_that_ran_well_counts_anew() -> None:
    world = World(spec(restart=RestartPolicy.ON_FAILURE, max_restarts=1))
    for number in range(5):
        world.wait(WELL_S)
        world.end()
        assert world.status().detail == "exit code 3; starts again after 0.5 s"
        world.wait(0.5)
        assert world.status().restarts == number + 1
    world.wait(WELL_S - 1)
    world.end()
    assert world.status().state is NodeState.FAILED


def test_unstartable_node_is_not_retried_in_vain() -> None:
    """What cannot be started is not tried again if that would not help."""
    world = World(spec(restart=RestartPolicy.ALWAYS))
    world.refuse()
    assert world.status().state is NodeState.FAILED
    assert world.status().detail == "no package 'x'"
    assert world.told == ["node a cannot be started: no package 'x'"]
    other = World(spec(restart=RestartPolicy.ALWAYS))
    other.refuse(hopeless=False)
    assert other.status().state is NodeState.WAITING


def test_a_changed_node_is_ended_and_started_anew() -> None:
    world = World(spec())
    world.register()
    world.desire(spec(args="new"))
    assert (world.status().state, world.halting) == (NodeState.STOPPING, {"a": 1.0})
    world.end(code=-2)
    assert world.status().state is NodeState.STARTING
    assert world.told == []
    assert world.launched == ["a", "a"]


def test_change_taken_back_while_ending_restarts_node() -> None:
    """A change that is taken back while it ends still starts it anew."""
    world = World(spec())
    world.desire(spec(args="new"))
    world.desire(spec())
    world.end(code=-2)
    assert (world.status().state, world.told) == (NodeState.STARTING, [])
    world.desire()
    world.desire(spec())
    world.end(code=-2)
    assert (world.status().state, world.told) == (NodeState.STARTING, [])


def test_another_way_of_watching_leaves_the_process_alone() -> None:
    world = World(spec())
    world.register()
    world.desire(spec(restart=RestartPolicy.ALWAYS, max_restarts=2, heartbeat="beat"))
    assert not world.halting
    world.end()
    assert world.status().state is NodeState.WAITING


def test_a_node_that_failed_is_started_by_any_change() -> None:
    world = World(spec())
    world.end()
    world.desire(spec(max_restarts=7))
    assert world.status().state is NodeState.STARTING


def test_events_of_an_older_life_are_ignored() -> None:
    world = World(spec(restart=RestartPolicy.ALWAYS))
    world.made()
    world.end()
    world.wait(0.5)
    before = world.core.statuses
    for event in (
        e.Made("a", 1, 7),
        e.Registered("a", 1),
        e.Ended("a", 1, 0, ""),
        e.Refused("a", 1, "", True),
    ):
        world.do(event)
        assert world.core.statuses == before
    world.do(e.Registered("nobody", 1))
    world.do(e.Beat("nobody"))


# Order


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


# Health


def beating(**life: Unpack[NodeLife]) -> World:
    life["heartbeat"], life["heartbeat_timeout"] = "/beat", 2.0
    world = World(spec(**life))
    world.register()
    world.do(e.Beat("a"))
    return world


def test_a_silent_node_is_stuck_until_it_beats_again() -> None:
    world = beating()
    for _ in range(10):
        world.wait(1.9)
        world.do(e.Beat("a"))
    assert world.status().state is NodeState.RUNNING
    world.wait(2.0)
    status = world.status()
    assert (status.state, status.detail) == (NodeState.STUCK, "no message on /beat any more")
    assert world.told == ["node a is stuck: no message on /beat any more"]
    assert world.core.is_degraded
    world.wait(100)
    assert not world.halting, "nobody asked for it to be restarted"
    world.do(e.Beat("a"))
    assert (world.status().state, world.core.is_degraded) == (NodeState.RUNNING, False)
    world.wait(2.0)
    assert world.status().state is NodeState.STUCK


def test_a_stuck_node_is_restarted_if_its_policy_says_so() -> None:
    world = beating(restart=RestartPolicy.ON_FAILURE, max_restarts=1)
    world.wait(2.0)
    assert world.status().state is NodeState.STUCK, "it is seen to be stuck before it is ended"
    world.wait(LAST_CHANCE_S)
    assert (world.status().state, set(world.halting)) == (NodeState.STOPPING, {"a"})
    assert world.core.is_degraded
    world.end(code=0)
    assert world.status().detail == (
        "stuck: no message on /beat any more; exit code 0; starts again after 0.5 s"
    )
    world.wait(0.5)
    world.register()
    world.do(e.Beat("a"))
    world.wait(2.0 + LAST_CHANCE_S)
    world.end(code=-9)
    assert world.status().state is NodeState.FAILED, "the limit counts here too"


def test_a_stuck_node_has_a_last_chance() -> None:
    world = beating(restart=RestartPolicy.ALWAYS)
    world.wait(2.0)
    world.wait(LAST_CHANCE_S / 2)
    world.do(e.Beat("a"))
    world.wait(1.9)
    assert (world.status().state, world.halting) == (NodeState.RUNNING, {})


def test_a_heart_that_never_began_to_beat_has_longer() -> None:
    world = World(spec(heartbeat="/beat", heartbeat_timeout=2.0))
    world.register()
    world.wait(FIRST_BEAT_WITHIN_S - 0.1)
    assert world.status().state is NodeState.RUNNING
    world.wait(0.1)
    assert world.status().state is NodeState.STUCK


def test_a_stuck_node_that_is_to_go_waits_for_its_turn() -> None:
    world = World(
        spec("a", heartbeat="/beat", heartbeat_timeout=2.0, restart=RestartPolicy.ALWAYS),
        spec("b", after=("a",)),
    )
    world.register("a")
    world.do(e.Beat("a"))
    world.desire()
    world.wait(100)
    assert world.halted == ["b"]
    world.end("b")
    world.end("a")
    assert world.states() == {}


def test_a_node_that_never_registers_says_so_and_goes_on() -> None:
    world = World(spec("a"), spec("b", after=("a",)))
    world.wait(100)
    assert world.status("a").state is NodeState.STARTING
    assert world.status("a").detail.startswith("it has not registered with the ROS core")
    world.register("a")
    assert world.status("a").detail == ""
    assert world.states()["b"] is NodeState.STARTING


# Readiness


def test_nodes_settle() -> None:
    world = World(spec("a"), spec("b", after=("a",)))
    settles = world.core.is_settling
    assert settles(9.9)
    assert not settles(10.1), "it never registers, and the other one waits for that"
    world.now = 4.0
    world.register("a")
    assert settles(13.9), "the next one begins"
    world.register("b")
    assert settles(4.4)
    assert not settles(4.6)


def test_a_node_that_comes_back_soon_is_waited_for() -> None:
    world = World(spec(restart=RestartPolicy.ALWAYS))
    world.end()
    assert world.core.is_settling(0.4)
    for _ in range(3):
        world.wait(30)
        world.end()
    assert world.core.is_settling(world.now + 0.1)
    world.desire()
    assert not world.core.is_settling(world.now)


# The table, and everything at once


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


def test_node_without_package_waits_running_one_stays() -> None:
    """A node that lacks its package waits and one that runs is left alone."""
    world = World()
    world.do(e.Lack({"a": "waits for its package nav 1.0"}))
    world.desire(spec("a"), spec("b"), spec("c", after=("a",)))
    assert world.launched == ["b"]
    assert (world.status().state, world.status().detail) == (
        NodeState.WAITING,
        "waits for its package nav 1.0",
    )
    assert "a (waiting)" in world.status("c").detail
    world.do(e.Lack({"b": "waits for its package nav 2.0"}))
    assert world.launched == ["b", "a"]
    assert world.halted == []
    assert world.told == []
