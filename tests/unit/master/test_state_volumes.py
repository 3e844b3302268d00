"""Volumes in the master's state: where they are, who has them, and their removal."""

from __future__ import annotations

import pytest
from support.master_world import World

from rce.model import MEGABYTE, Volume
from rce_master.exceptions import ConflictError, LimitReachedError, NoRoomError, NotFoundError
from rce_master.state import commands
from rce_master.state.core import State
from rce_master.state.settings import StateSettings
from rce_master.state.volume_records import UserVolume

SIZE = 64 * MEGABYTE


def volume(name: str = "journal", path: str = "/data", size: int = SIZE) -> Volume:
    return Volume(name=name, path=path, size=size)


def machine(world: World, process: str, volumes: str = "image") -> None:
    world.container_set(process, name=f"machine_{process}", slots=4, volumes=volumes)


@pytest.fixture
def two() -> World:
    """Two machines; a container with a volume is on the first one."""
    world = World()
    machine(world, "c1")
    world.container("c", volumes=(volume(),))
    machine(world, "c2")
    return world


def known(world: World) -> list[UserVolume]:
    return list(world.state.tables.volumes)


def place(world: World, tag: str = "c") -> str:
    return world.state.tables.endpoints[f"anna/{tag}"].task_set


def destroy(world: World, tag: str = "c") -> None:
    process = place(world, tag)
    world.do(commands.DestroyContainer(user="anna", tag=tag))
    if process:
        world.do(commands.EndpointGone(process=process, id=f"anna/{tag}"))


def remove(world: World, name: str = "journal") -> list[str]:
    changes = world.do(commands.RemoveVolume(user="anna", name=name))
    return [f"{removal.process} {removal.volume}" for removal in changes.volume_removals]


def test_a_volume_stays_on_its_machine(two: World) -> None:
    assert known(two) == [UserVolume(user="anna", name="journal", size=SIZE, process="c1", placement=1)]
    destroy(two)
    for number in range(3):  # the first machine is fuller than the second one
        two.container(f"other{number}")
    two.container("again", volumes=(volume(),))
    assert place(two, "again") == "c1"


def test_a_container_waits_for_the_machine_of_its_volume(two: World) -> None:
    two.leave("c1")
    two.tick(100)
    assert place(two) == ""
    two.tick(100)
    text = two.state.tables.container_live("anna/c").stays
    assert "the machine with its volumes (journal) is away: c1" in text
    machine(two, "c1")
    assert place(two) == "c1"


def test_a_new_container_is_refused_while_its_volume_is_away(two: World) -> None:
    destroy(two)
    two.leave("c1")
    two.tick(100)
    with pytest.raises(NoRoomError, match=r"its volumes \(journal\) is away"):
        two.container("again", volumes=(volume(),))


def test_it_stays_on_a_machine_of_the_release_before(two: World) -> None:
    two.run("c", "c1")
    two.do(commands.SetDraining(machine="c1", draining=True))
    assert not list(two.state.tables.moves)
    assert not list(two.state.tables.volume_moves)
    text = two.state.tables.container_live("anna/c").stays
    assert "volumes of container 'c' are on this machine" in text
    assert "it runs an earlier release" in text


def test_one_container_at_a_time_has_it(two: World) -> None:
    with pytest.raises(ConflictError, match="belongs to container 'c'"):
        two.container("d", volumes=(volume(),))
    two.user("bob")
    two.container("d", user="bob", volumes=(volume(),))
    assert {one.id for one in known(two)} == {"anna/journal", "bob/journal"}


def test_it_grows_and_does_not_shrink(two: World) -> None:
    destroy(two)
    with pytest.raises(ConflictError, match="has 64 MB and cannot shrink to 32 MB"):
        two.container("d", volumes=(volume(size=SIZE // 2),))
    two.container("d", volumes=(volume(size=2 * SIZE),))
    assert [one.size for one in known(two)] == [2 * SIZE]


def test_volumes_of_two_machines_do_not_meet(two: World) -> None:
    two.container("d", volumes=(volume("other"),), size=4)
    assert place(two, "d") == "c2"
    for tag in ("c", "d"):
        destroy(two, tag)
    with pytest.raises(ConflictError, match="are on different machines"):
        two.container("both", volumes=(volume(), volume("other", "/more")))


def test_its_size_counts_as_disk() -> None:
    world = World(StateSettings(max_package_size=100 * MEGABYTE))
    machine(world, "c1")
    world.container("c", volumes=(volume(),))
    with pytest.raises(LimitReachedError, match="would take 128 MB of disk, and you may have 100 MB"):
        world.container("d", volumes=(volume("other"),))
    destroy(world)
    with pytest.raises(LimitReachedError):
        world.container("d", volumes=(volume("other"),))
    remove(world)
    world.container("d", volumes=(volume("other"),))


def test_it_is_removed_only_without_a_container(two: World) -> None:
    with pytest.raises(ConflictError, match="belongs to container 'c'"):
        remove(two)
    destroy(two)
    assert remove(two) == ["c1 anna/journal"]
    assert known(two) == []
    with pytest.raises(NotFoundError, match="no volume 'journal'"):
        remove(two)


def test_a_former_volume_keeps_its_machine_until_it_is_gone(two: World) -> None:
    """A new one of the same name would be removed with it."""
    destroy(two)
    remove(two)
    two.container("again", volumes=(volume(),))
    assert place(two, "again") == "c2"
    two.do(commands.VolumeRemoved(process="c1", volume="anna/journal"))
    assert not list(two.state.tables.volume_removals)


def test_removals_outlive_the_master(two: World) -> None:
    destroy(two)
    remove(two)
    tables = [table for table in two.state.tables.all if table.persistent]
    snapshot = {table.name: {table.key(record): table.encode(record) for record in table} for table in tables}
    later = State.load(snapshot, now=0.0)
    assert [one.volume for one in later.tables.volume_removals.by("process", "c1")] == ["anna/journal"]


def test_a_volume_that_never_had_a_machine_vanishes() -> None:
    world = World()
    world.container("c", volumes=(volume(),))
    assert [one.process for one in known(world)] == [""]
    destroy(world)
    assert known(world) == []


def test_a_machine_of_the_release_before_takes_none() -> None:
    world = World()
    machine(world, "c1", volumes="")
    with pytest.raises(NoRoomError, match="has no volumes"):
        world.container("c", volumes=(volume(),))


def test_volumes_of_a_removed_user_are_removed(two: World) -> None:
    two.user("bob")
    changes = two.do(commands.RemoveUser(name="anna"))
    assert [one.volume for one in changes.volume_removals] == ["anna/journal"]
    assert known(two) == []
