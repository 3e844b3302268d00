from __future__ import annotations

import pytest
from support.master_world import World

from rce.model.quantities import MEGABYTE as MB
from rce.model.specs import ResourceChanges
from rce_master.exceptions import LimitReachedError, NotFoundError
from rce_master.state import commands
from rce_master.state.limits import limit_of, used_of
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import UserRole


def limit(world: World, kind: str, user: str = "anna") -> tuple[float, str]:
    found = limit_of(world.state.tables, world.state.settings, user, kind)
    return found.most, found.source


def allow(world: World, user: str = "anna", **limits: float | None) -> None:
    world.do(commands.SetLimits(user=user, limits=limits))


def test_a_share_of_what_the_machines_have() -> None:
    world = World(StateSettings(user_share=0.5))
    assert limit(world, "slots") == (0, "all")
    world.container_set("c1", slots=10, cores=4, memory=1000 * MB)
    world.container_set("c2", slots=10, cores=2, memory=1000 * MB)
    assert limit(world, "slots") == (10, "machines")
    assert limit(world, "cpu") == (3, "machines")
    assert limit(world, "memory") == (1000 * MB, "machines")
    world.leave("c2")  # it may come back
    assert limit(world, "slots") == (10, "machines")
    world.container("a", size=10)
    text = (
        "your containers would have 11 slots in all, and you may have 10, 50% of what the machines have; "
        "make others smaller (rce resize) or destroy them, or have an administrator allow more: "
        "rce user limit anna --slots"
    )
    with pytest.raises(LimitReachedError) as refused:
        world.container("b")
    assert str(refused.value) == text


def test_the_smaller_of_share_and_number_counts() -> None:
    world = World(StateSettings(user_share=0.5, max_slots=4))
    world.container_set("c1", slots=10)
    assert limit(world, "slots") == (4, "all")
    world = World(StateSettings(user_share=0.5, max_slots=40))
    world.container_set("c1", slots=10)
    assert limit(world, "slots") == (5, "machines")


def test_limits_of_one_user_win_until_they_are_taken_back() -> None:
    world = World(StateSettings(max_containers=1, user_share=0.1))
    world.user("bert")
    world.container_set("c1", slots=10)
    allow(world, containers=3, slots=0)
    world.container("a")
    world.container("b", size=5)
    assert limit(world, "slots") == (0, "user")
    world.container("a", "bert")
    with pytest.raises(
        LimitReachedError, match=r"you have 1 containers already; .*rce user limit bert --containers"
    ):
        world.container("b", "bert")
    allow(world, containers=None)
    with pytest.raises(LimitReachedError):
        world.container("c")
    assert limit(world, "slots") == (0, "user")
    world.do(commands.RemoveUser(name="anna"))
    assert len(world.state.tables.user_limits) == 0
    with pytest.raises(NotFoundError):
        allow(world, "nobody", slots=1)


def test_a_user_over_a_new_limit_may_shrink_and_not_grow() -> None:
    world = World()
    world.container_set("c1", slots=10, cores=8, memory=8000 * MB)
    tags = [f"c{number}" for number in range(4)]
    for tag in tags:
        world.container(tag, cpu=1, memory=100 * MB)
    allow(world, cpu=2, slots=4)

    def resize(tag: str, changes: ResourceChanges) -> None:
        world.do(commands.ResizeContainer(user="anna", tag=tag, changes=changes))

    resize("c0", ResourceChanges(bandwidth=1000))
    resize("c0", ResourceChanges(cpu=0.5))
    resize("c1", ResourceChanges(memory=200 * MB))
    assert used_of(world.state.tables, "anna")["cpu"] == 3.5
    with pytest.raises(LimitReachedError, match=r"would have 3.6 cores in all, and you may have 2"):
        resize("c0", ResourceChanges(cpu=0.6))
    with pytest.raises(LimitReachedError, match="5 slots"):
        resize("c0", ResourceChanges(size=2, cpu=0.1))
    with pytest.raises(LimitReachedError):
        world.container("more", cpu=0.1)


def test_administrators_have_none_unless_it_is_set() -> None:
    world = World(StateSettings(max_containers=1, max_cpu=1, max_packages=5))
    world.user("root", UserRole.ADMIN)
    found = [limit(world, kind, "root") for kind in ("containers", "cpu", "packages")]
    assert found == [(0, "role"), (0, "role"), (5, "all")]
    allow(world, "root", cpu=2)
    assert limit(world, "cpu", "root") == (2, "user")


def test_what_is_used_is_counted() -> None:
    world = World()
    world.container("a", size=2, cpu=0.5, memory=64 * MB)
    world.container("b")
    used = used_of(world.state.tables, "anna")
    assert used == {"containers": 2, "slots": 3, "cpu": 0.5, "memory": 64 * MB, "packages": 0, "disk": 0}
