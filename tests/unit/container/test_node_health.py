"""Nodes that are silent, that never register, and those that settle."""

from __future__ import annotations

from typing import Unpack

from support.node_world import World, spec
from support.parts import NodeLife

from rce.control.model import NodeState
from rce.model.specs import RestartPolicy
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.core import FIRST_BEAT_WITHIN_S
from rce_container.environment.nodes.record import LAST_CHANCE_S


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
    assert not world.halting, "no restart was asked for"
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
