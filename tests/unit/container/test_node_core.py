"""What is decided about a container's nodes: starts, ends, restarts and changes."""

from __future__ import annotations

import pytest
from support.node_world import World, spec

from rce.control.model import NodeState, NodeStatus
from rce.model.specs import RestartPolicy
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.record import WELL_S

FAILED = "exit code 3"


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
