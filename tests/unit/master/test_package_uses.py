"""What is said of the nodes that need a package, however many there are."""

from __future__ import annotations

import pytest
from support.master_world import World, restarted

from rce.model.specs import NodeSpec
from rce_master.exceptions import ConflictError
from rce_master.state import commands
from rce_master.state.packages import SHOWN, Uses, uses
from rce_master.state.user_records import PackageKey, UserPackage

KEY = "ab" * 32


def package(version: str) -> UserPackage:
    return UserPackage(
        user="anna",
        name="tools",
        version=version,
        sha256=version.rjust(64, "0"),
        digest=version,
        key=KEY,
        signature="",
        packed=1,
        size=1,
        files=1,
        created=1.0,
    )


def add_node(world: World, container: str, tag: str, pkg: str) -> None:
    world.state.apply(
        commands.AddNode(user="anna", container=container, node=NodeSpec(tag=tag, pkg=pkg, exe="x")),
        world.now,
    )


def uses_of(world: World, version: str, *, is_newest: bool = False) -> Uses:
    return uses(world.state.tables, package(version), is_newest=is_newest)


@pytest.fixture
def world() -> World:
    """Versions 1.0, 2.0 and 3.0; 40 containers with 15 nodes that need the first."""
    world = World()
    world.do(commands.AddPackageKey(key=PackageKey(user="anna", key=KEY, label="", created=1.0)))
    for version in ("1.0", "2.0", "3.0"):
        world.do(commands.AddPackage(package=package(version)))
    for number in range(40):
        world.state.apply(commands.CreateContainer(user="anna", tag=f"c{number}"), world.now)
        for node in range(15):
            add_node(world, f"c{number}", f"n{node}", "tools@1.0")
    world.state.validate()
    return world


def remove(version: str) -> commands.RemovePackage:
    return commands.RemovePackage(user="anna", name="tools", version=version)


def test_a_refusal_names_some_of_the_nodes_only(world: World) -> None:
    with pytest.raises(ConflictError) as refusal:
        world.do(remove("1.0"))
    named = ", ".join(f"c0/n{number}" for number in range(SHOWN))
    assert f"tools 1.0 is used by {named}, and {600 - SHOWN} more; remove the nodes" in str(refusal.value)


def test_nodes_of_other_versions_are_not_looked_at(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = 0
    tables = world.state.tables
    find = tables.container

    def count(endpoint: str) -> object:
        nonlocal looked
        looked += 1
        return find(endpoint)

    monkeypatch.setattr(tables, "container", count)
    monkeypatch.setattr(tables, "containers", None)
    world.state.apply(remove("2.0"), world.now)
    assert looked == 0
    assert uses_of(world, "1.0").count == 600
    assert looked == 1, "its nodes suffice as examples"


def test_the_newest_is_needed_by_nodes_without_a_version(world: World) -> None:
    add_node(world, "c7", "any", "tools")
    add_node(world, "c8", "third", "tools@3.0")
    assert uses_of(world, "3.0", is_newest=True) == Uses(2, ("c8/third", "c7/any"))
    assert str(uses_of(world, "3.0", is_newest=True)) == "c8/third, c7/any"
    assert uses_of(world, "3.0") == Uses(1, ("c8/third",))
    assert uses_of(world, "2.0") == Uses(0, ())
    world.do(commands.RemoveNode(user="anna", container="c8", tag="third"))
    world.do(commands.DestroyContainer(user="anna", tag="c7"))
    world.do(remove("3.0"))
    assert uses_of(restarted(world), "1.0").count == 585


def test_a_new_version_reaches_the_nodes_without_one(world: World) -> None:
    add_node(world, "c7", "any", "tools")
    changes = world.do(commands.AddPackage(package=package("4.0")))
    assert list(changes.touched) == ["anna/c7"]
