"""What is decided about nodes whose state is kept."""

from __future__ import annotations

from support.node_world import World, spec

from rce.control.model import NodeState
from rce.model import NodeSpec, StateServices
from rce.model.specs import RestartPolicy
from rce_container.environment.nodes import events as e

SERVICES = StateServices(save="save", restore="restore", every=5.0)


def kept(restart: RestartPolicy = RestartPolicy.NEVER) -> NodeSpec:
    return spec(state_services=SERVICES, restart=restart)


def restored(world: World, fault: str = "") -> None:
    world.do(e.Restored("a", world.alive["a"], fault))


def unsaved(world: World, text: str) -> None:
    world.do(e.Unsaved("a", world.alive["a"], text))


def test_a_node_is_up_once_it_is_restored() -> None:
    world = World(kept(), spec("b", after=("a",)))
    world.register()
    assert (world.status().state, world.status().detail) == (NodeState.STARTING, "its state is restored")
    assert world.status("b").detail == "waits for a (its state is restored)"
    restored(world)
    assert (world.status().state, world.status().detail) == (NodeState.RUNNING, "")
    assert world.launched == ["a", "b"]
    assert not world.core.is_degraded


def test_a_node_that_is_restored_before_it_registers_is_up_then() -> None:
    world = World(kept())
    restored(world)
    assert world.status().state is NodeState.STARTING
    world.register()
    assert world.status().state is NodeState.RUNNING


def test_a_node_without_services_waits_for_nothing() -> None:
    world = World(spec())
    world.register()
    assert world.status().state is NodeState.RUNNING


def test_a_failed_restore_degrades_the_container() -> None:
    world = World(kept())
    world.register()
    restored(world, "it is rotten")
    status = world.status()
    assert status.state is NodeState.RUNNING
    assert status.detail == "its state was not restored, and is not saved: it is rotten"
    assert world.core.is_degraded
    assert world.told == [f"node a runs, but {status.detail}"]
    assert world.notes == [status.detail]


def test_the_next_life_is_restored_again() -> None:
    world = World(kept(RestartPolicy.ALWAYS))
    world.register()
    restored(world, "it is rotten")
    life = world.alive["a"]
    world.end()
    world.wait(60)
    assert world.alive["a"] != life
    world.register()
    world.do(e.Restored("a", life))
    assert world.status().state is NodeState.STARTING, "an earlier life was restored"
    restored(world)
    assert (world.status().state, world.core.is_degraded) == (NodeState.RUNNING, False)


def test_a_fault_of_saving_is_told_once_and_shown() -> None:
    world = World(kept())
    world.register()
    restored(world)
    for _ in range(3):
        unsaved(world, "its state is not saved: it hangs")
    assert world.told == ["node a runs, but its state is not saved: it hangs"]
    assert world.notes == ["its state is not saved: it hangs"]
    assert world.status().detail == "its state is not saved: it hangs"
    assert not world.core.is_degraded, "it works"
    unsaved(world, "")
    assert world.status().detail == ""
    assert world.notes[1:] == ["its state is saved again"]


def test_a_node_with_other_services_starts_again() -> None:
    """What was not restored must not be saved."""
    world = World(spec())
    world.register()
    world.desire(kept())
    assert world.halted == ["a"]
