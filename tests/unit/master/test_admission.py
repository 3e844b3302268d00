"""What is admitted, what waits, what is refused, and what can grow."""

from __future__ import annotations

from typing import TypedDict, Unpack

import pytest
from support.master_world import World

from rce.control.model import EndpointState, EndpointStatus
from rce.model.specs import Network, NodeSpec, ResourceChanges
from rce_master.exceptions import (
    ConflictError,
    ForbiddenError,
    InvalidRequestError,
    LimitReachedError,
    NoRoomError,
)
from rce_master.state import commands, placing
from rce_master.state.changes import Changes, Transaction
from rce_master.state.placement import Room
from rce_master.state.records import Container
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import UserRole

MB = 1 << 20


def at(world: World, tag: str, user: str = "anna") -> str:
    return world.state.tables.endpoints[f"{user}/{tag}"].task_set


class Resize(TypedDict, total=False):
    size: int
    cpu: float
    memory: int
    bandwidth: int


def resize(world: World, tag: str = "c", user: str = "anna", **requested: Unpack[Resize]) -> Changes:
    return world.do(commands.ResizeContainer(user=user, tag=tag, changes=ResourceChanges(**requested)))


def gone(world: World, tag: str, process: str = "c1") -> None:
    world.do(commands.DestroyContainer(user="anna", tag=tag))
    world.do(commands.EndpointGone(process=process, id=f"anna/{tag}"))


def test_out_of_capacity_names_what_is_missing_where(world: World) -> None:
    world.container_set("c1", name="m1", cores=2)
    world.container_set("c2", name="m2", cores=8, labels=("lidar",))
    world.container("a", cpu=0.5, special_features=())
    with pytest.raises(NoRoomError) as caught:
        world.container("big", cpu=4.0, special_features=("gpu",))
    assert str(caught.value) == (
        "no machine takes container 'big' now: m1 lacks the label gpu; m2 lacks the label gpu; "
        "to wait for room, ask with wait"
    )
    assert caught.value.status == 409
    with pytest.raises(
        NoRoomError, match=r"m1 has 2 of 2 cores free, 9 needed; m2 has 7\.5 of 8 cores free, 9 needed"
    ):
        world.container("big", cpu=9.0)
    assert "anna/big" not in world.state.tables.endpoints


def test_who_waits_is_told_at_once_and_again_when_there_is_room(world: World) -> None:
    world.container_set("c1", slots=2)
    world.container("a", size=2)
    changes = world.container("b", wait=True)
    assert (
        "waits for a machine and starts as soon as one takes it: m has 0 of 2 slots free"
        in changes.notices[0].text
    )
    assert world.phase("b") == "requested"
    assert world.tick(60).notices == []
    world.do(commands.DestroyContainer(user="anna", tag="a"))
    changes = world.do(commands.EndpointGone(process="c1", id="anna/a"))
    assert world.phase("b") == "placed"
    assert [notice.text for notice in changes.notices] == ["container 'b' has a machine now: m"]


def test_waiting_are_served_in_order_unless_unplaceable(
    world: World,
) -> None:
    """Those that wait are served in order and a small one passes only one that fits nowhere."""
    world.container_set("c1", slots=4)
    world.container("full", size=4)
    world.container("big", size=3, wait=True)
    world.container("small", size=1, wait=True)
    world.container("last", size=3, wait=True)
    gone(world, "full")
    assert [world.phase(tag) for tag in ("big", "small", "last")] == ["placed", "placed", "requested"]
    world.container("more", size=1, wait=True)
    gone(world, "small")
    assert [world.phase(tag) for tag in ("last", "more")] == ["requested", "placed"], "last fits nowhere"
    gone(world, "big")
    assert world.phase("last") == "placed"


def test_without_any_machine_containers_wait_as_ever(world: World) -> None:
    world.container("c", cpu=100.0)
    assert world.phase() == "requested"
    world.container_set("c1", cores=2)
    assert world.phase() == "requested"
    assert "100 needed" in world.tick(10).notices[0].text


def test_a_machine_that_may_come_back_is_waited_for(world: World) -> None:
    world.container_set("c1", name="m1", labels=("gpu",))
    world.container_set("c2", name="m2")
    world.leave("c1")
    world.container("c", special_features=("gpu",))
    assert world.phase() == "requested"
    world.container_set("c1", name="m1", labels=("gpu",))
    assert at(world, "c") == "c1"
    world.leave("c1")
    world.tick(30)
    with pytest.raises(NoRoomError):
        world.container("d", special_features=("gpu",))


def test_the_same_again_is_not_counted_twice(world: World) -> None:
    world.container_set("c1", slots=1)
    world.container()
    world.container()
    with pytest.raises(ConflictError):
        world.container(size=2)


def test_remade_container_waits_only_for_its_predecessor(world: World) -> None:
    """A container made again at a full machine waits for its former self only."""
    world.container_set("c1", slots=1)
    world.container()
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    world.container()
    assert world.phase() == "requested"
    world.do(commands.EndpointGone(process="c1", id="anna/c"))
    assert world.phase() == "placed"


def test_oversized_container_is_not_taken_back(world: World) -> None:
    """A container that a machine cannot hold is not taken back."""
    world.container_set("c1", slots=2)
    world.container()
    world.run()
    world.leave("c1")
    world.tick(30)
    resize(world, size=3)
    status = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING)
    world.container_set("c1", slots=2, endpoints=(status,))
    assert world.phase() == "lost"


# What one user may ask for


def test_users_have_limits_administrators_have_none() -> None:
    """A users containers have limits and an administrators have none."""
    world = World(StateSettings(max_slots=3, max_cpu=1.5, max_memory=100 * MB))
    world.user("root", UserRole.ADMIN)
    world.container("a", size=2, cpu=1.0, memory=64 * MB)
    with pytest.raises(
        LimitReachedError, match="would have 4 slots in all, and you may have 3; make others smaller"
    ):
        world.container("b", size=2)
    with pytest.raises(LimitReachedError, match=r"would have 2 cores in all, and you may have 1\.5"):
        world.container("b", cpu=1.0)
    with pytest.raises(LimitReachedError, match="would have 128 MB of memory in all, and you may have 100"):
        world.container("b", memory=64 * MB)
    with pytest.raises(LimitReachedError, match="slots"):
        resize(world, "a", size=4)
    resize(world, "a", size=1)
    world.container("b", size=2)
    world.container("b", "root", size=20, cpu=20.0, memory=2000 * MB)


def test_too_little_memory_is_refused_before_it_kills(world: World) -> None:
    with pytest.raises(
        InvalidRequestError, match=r"memory: 1 MB are too little; a container itself needs 32 MB"
    ):
        world.container(memory=MB)


def test_the_machines_network_and_folders_are_for_administrators(world: World) -> None:
    world.user("root", UserRole.ADMIN)
    world.container_set("c1", networks=("none", "host"), runtimes=("podman",))
    with pytest.raises(ForbiddenError, match="network: host is for containers of administrators"):
        world.container(network=Network.HOST)
    with pytest.raises(ForbiddenError, match="image: folders of the machine are for administrators"):
        world.container(image="/")
    world.container(image="debian:12")
    world.container("c", "root", network=Network.HOST, image="/srv/rootfs")


def test_a_group_is_on_one_machine_with_addresses_of_one_network(world: World) -> None:
    world.user("bob")
    for process in ("c1", "c2"):
        world.container_set(process, networks=("none", "group"), slots=3)

    def member(tag: str, address: str = "", user: str = "anna") -> None:
        world.container(tag, user, network=Network.GROUP, group="g", group_ip=address)

    member("a", "10.0.0.2/24")
    with pytest.raises(
        ConflictError, match=r"groupIp: 10\.0\.0\.2 is the address of container 'a' of the group 'g'"
    ):
        member("b", "10.0.0.2")
    with pytest.raises(ConflictError, match=r"groupIp: 10\.0\.1\.3/24 is not in 10\.0\.0\.0/24"):
        member("b", "10.0.1.3")
    member("b", "10.0.0.3")
    member("c")
    assert at(world, "a") == at(world, "b") == at(world, "c")
    with pytest.raises(NoRoomError, match="0 of 3 slots free"):
        member("d")
    member("a", "10.0.0.2", "bob")
    assert at(world, "a", "bob") != at(world, "a")


def test_containers_that_are_joined_are_placed_together_again(world: World) -> None:
    world.container_set("c1", slots=100)
    world.container("c")
    world.container("d")
    world.interface("c/i", "PublisherInterface")
    world.interface("d/i", "SubscriberInterface")
    world.connect("c/i", "d/i")
    world.container_set("c2", slots=100)
    world.container_set("c3", slots=100)
    world.leave("c1")
    world.tick(30)
    assert at(world, "c") == at(world, "d") != "c1"


# Resizing


def test_a_container_is_resized_while_it_runs(world: World) -> None:
    world.container_set("c1", cores=2, memory=1000 * MB)
    world.container(cpu=1.0, memory=100 * MB, bandwidth=5)
    world.run()
    changes = resize(world, cpu=0.5, memory=256 * MB)
    assert list(changes.touched) == ["anna/c"]
    assert [(h.kind, h.text) for h in changes.events] == [
        ("container_resized", "size 1, cpu 0.5, memory 256 MB, bandwidth 5B/s")
    ]
    requested = world.spec("c").resources
    assert (requested.cpu, requested.memory, requested.bandwidth) == (0.5, 256 * MB, 5)
    assert world.phase() == "running"
    assert list(resize(world, cpu=0.5).touched) == []
    resize(world, cpu=0.0)
    assert world.spec("c").resources.cpu == 0.0


def test_what_has_no_room_to_grow_is_told_and_stays_as_it_is(world: World) -> None:
    world.container_set("c1", name="m1", cores=2)
    world.container(cpu=1.0)
    world.container("other", cpu=0.5)
    before = world.spec("c")
    with pytest.raises(NoRoomError) as caught:
        resize(world, cpu=4.0)
    assert str(caught.value) == (
        "container 'c' cannot grow so far: m1 has 1.5 of 2 cores free, 4 needed; nothing was changed"
    )
    assert world.spec("c") == before
    resize(world, cpu=1.5)


def test_shrinking_makes_room_for_those_that_wait(world: World) -> None:
    world.container_set("c1", slots=3)
    world.container(size=3)
    world.container("next", wait=True)
    resize(world, size=2)
    assert world.phase("next") == "placed"


def test_returning_client_may_ask_for_either_size(world: World) -> None:
    """A client that comes back may ask for the size before or after."""
    world.container(cpu=1.0)
    resize(world, cpu=0.5)
    world.container(cpu=1.0)
    world.container(cpu=0.5)
    assert world.spec("c").resources.cpu == 0.5
    with pytest.raises(ConflictError):
        world.container(cpu=2.0)


# Nodes


def test_nodes_may_not_wait_for_one_another_in_a_circle(world: World) -> None:
    world.container()

    def add(tag: str, *after: str) -> None:
        node = NodeSpec(tag=tag, pkg="p", exe="e", after=after)
        world.do(commands.AddNode(user="anna", container="c", node=node))

    add("a", "b", "c")
    add("b", "c")
    with pytest.raises(InvalidRequestError, match="node 'c': after goes round in a circle: c after"):
        add("c", "a")
    add("c")


def test_many_that_wait_cost_little(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    world.container_set("c1", name="m1", slots=2)
    world.container("first")
    looked: list[str] = []

    def choose(tx: Transaction, container: Container, rooms: dict[str, Room]) -> Room | None:
        looked.append(container.tag)
        return best(tx, container, rooms)

    best = placing.best
    monkeypatch.setattr(placing, "best", choose)
    for number in range(5):
        world.container(f"c{number}", wait=True, size=2)
    assert looked == [], "that none of them fits is seen once, and without looking at each"
    world.container("small", wait=True)
    assert looked == ["small"], "who fits passes those that do not"
    world.tick(1)
    assert looked == ["small"]
