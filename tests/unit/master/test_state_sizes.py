"""How much one endpoint, and one user, may put into the master's state."""

from __future__ import annotations

import pytest
from support.master_world import World

from rce.model.specs import InterfaceSpec, NodeSpec, ParameterValue
from rce_master.exceptions import LimitReachedError
from rce_master.state import commands
from rce_master.state.records import Container
from rce_master.state.settings import StateSettings

LARGE = "x" * 40_000


@pytest.fixture
def world() -> World:
    world = World(StateSettings(max_endpoint_bytes=100_000, max_user_bytes=150_000))
    for tag in ("c", "d"):
        world.do(commands.CreateContainer(user="anna", tag=tag))
    return world


def put(world: World, name: str, value: ParameterValue = LARGE, container: str = "c") -> None:
    world.do(commands.SetParameter(user="anna", container=container, name=name, value=value))


def size(world: World, container: str = "c") -> int:
    found = world.state.tables.endpoints[f"anna/{container}"]
    assert isinstance(found, Container)
    return found.size


def test_freed_room_of_endpoint_can_be_used_again(world: World) -> None:
    """An endpoint holds so much and room that is freed can be used again."""
    put(world, "a")
    put(world, "b")
    with pytest.raises(LimitReachedError, match="'c' would hold more than 100000 bytes"):
        put(world, "third")
    node = NodeSpec(tag="n", pkg="p", exe="e", args=LARGE)
    with pytest.raises(LimitReachedError):
        world.do(commands.AddNode(user="anna", container="c", node=node))
    put(world, "b", 1)
    put(world, "b", LARGE)
    world.do(commands.DeleteParameter(user="anna", container="c", name="a"))
    put(world, "third")


def test_a_user_holds_so_much_in_all(world: World) -> None:
    put(world, "a")
    put(world, "b")
    put(world, "a", container="d")
    with pytest.raises(LimitReachedError, match="your robots and containers would hold more than 150000"):
        put(world, "b", container="d")
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    put(world, "b", container="d")


def test_what_is_taken_out_counts_no_more(world: World) -> None:
    before = size(world)
    node = NodeSpec(tag="n", pkg="p", exe="e")
    interface = InterfaceSpec(tag="i", type="PublisherInterface", message_type="a/B", addr="/x")
    world.do(commands.AddNode(user="anna", container="c", node=node))
    world.do(commands.AddInterface(user="anna", endpoint="c", interface=interface))
    put(world, "a", 1)
    assert size(world) > before
    world.do(commands.RemoveNode(user="anna", container="c", tag="n"))
    world.do(commands.RemoveInterface(user="anna", endpoint="c", tag="i"))
    world.do(commands.DeleteParameter(user="anna", container="c", name="a"))
    assert size(world) == before
