"""Many machines and many that wait: candidates by load, and work that is left to later commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from random import Random

import pytest
from support.master_world import World
from support.placement import choose

from rce.control.messages import CONTROL_VERSION, Hello, MachineInfo, TaskSetKind
from rce.model.specs import Network, Resources
from rce.model.volumes import Volume
from rce_master.exceptions import RefusedError
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.placement import Room
from rce_master.state.rooms import CANDIDATES, Rooms
from rce_master.state.settings import StateSettings

MB = 1 << 20
GRACE = StateSettings().container_grace


def places(world: World) -> list[str]:
    """The machines of all containers, in the order in which they were asked for."""
    return [c.task_set for c in sorted(world.state.tables.containers(), key=lambda c: c.number)]


def finish(world: World, changes: Changes) -> int:
    """Do what was left over; return how many commands that took."""
    count = 0
    while changes.unfinished:
        changes = world.do(commands.Continue())
        count += 1
    return count


def test_machine_lost_is_replaced_in_slices() -> None:
    world = World(StateSettings(max_work=1000))
    world.container_set("c1", name="m1", slots=40)
    for number in range(40):
        world.container(f"c{number}")
    world.container_set("c2", name="m2", slots=40)
    world.leave("c1")
    first = world.tick(GRACE)
    lost = sum(event.kind == "container_lost" for event in first.events)
    assert 0 < lost < 40, "a command gives up only some of them"
    assert finish(world, first) > 5
    assert places(world) == ["c2"] * 40
    assert "c1" not in world.state.tables.task_sets


def test_slices_keep_the_order_of_the_queue() -> None:
    """A machine that gains room while a pass is under way is offered to the first in the queue first."""
    world = World(StateSettings(max_work=1))
    world.container_set("c1", name="m1", slots=3)
    world.container("big", size=3)
    for tag in ("w1", "w2", "w3", "w4"):
        world.container(tag, size=2, wait=True)
    world.do(commands.DestroyContainer(user="anna", tag="big"))
    changes = world.do(commands.EndpointGone(process="c1", id="anna/big"))
    assert changes.unfinished, "w1 has it, and the others were not looked at"
    world.container_set("c2", name="m2", slots=3)
    finish(world, world.do(commands.Continue()))
    assert places(world) == ["c1", "c2", "", ""]


def test_a_machine_that_comes_during_a_pass_is_not_left_empty() -> None:
    """What found no room in the pass that was under way finds it in the next one, of the same command."""
    world = World(StateSettings(max_work=1000))
    for number in range(10):
        world.container(f"w{number}")
    changes = world.container_set("c1", name="m1", slots=6)
    assert changes.unfinished
    assert 0 < places(world).count("c1") < 6
    finish(world, world.container_set("c2", name="m2", slots=6))
    assert places(world) == ["c1"] * 6 + ["c2"] * 4


def test_settled_queue_is_not_looked_at(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.container_set("c1", slots=1)
    world.container("first")
    for number in range(5):
        world.container(f"c{number}", wait=True, cpu=number / 10)
    assert not world.state.tables.queue.has_work
    monkeypatch.setattr(world.state.tables.rooms, "candidates", None)
    world.tick(1)


def test_volume_that_is_gone_makes_room_for_its_name(world: World) -> None:
    world.container_set("c1", slots=4, volumes="kernel")
    resources = Resources(volumes=(Volume(name="v", path="/v", size=64 * MB),))
    made = commands.CreateContainer(user="anna", tag="c", resources=resources, wait=True)
    world.do(made)
    assert world.phase() == "placed"
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    world.do(commands.EndpointGone(process="c1", id="anna/c"))
    world.do(commands.RemoveVolume(user="anna", name="v"))
    world.do(made)
    assert world.phase() == "requested"
    world.do(commands.VolumeRemoved(process="c1", volume="anna/v"))
    assert world.phase() == "placed"


def test_group_is_free_again_when_its_member_is_gone(world: World) -> None:
    world.container_set("c1", name="m1", networks=("none", "group"), slots=1)
    world.container("a", network=Network.GROUP, group="g")
    world.container("b", network=Network.GROUP, group="g", wait=True)
    world.container_set("c2", name="m2", networks=("none", "group"), slots=1)
    assert world.phase("b") == "requested", "its group is at c1"
    world.do(commands.DestroyContainer(user="anna", tag="a"))
    world.tick(0.5)
    assert world.phase("b") == "placed"


def test_undone_commands_leave_the_queue_as_it_was(world: World) -> None:
    world.container_set("c1", slots=2)
    world.container("a")
    world.container("big", size=2, wait=True)
    changes = world.do(commands.DestroyContainer(user="anna", tag="a"))
    gone = world.do(commands.EndpointGone(process="c1", id="anna/a"))
    assert world.phase("big") == "placed"
    gone.revert()
    changes.revert()
    world.state.validate()
    assert world.phase("big") == "requested"
    finish(world, world.do(commands.Continue()))
    assert world.phase("big") == "requested"
    world.do(commands.DestroyContainer(user="anna", tag="a"))
    world.do(commands.EndpointGone(process="c1", id="anna/a"))
    assert world.phase("big") == "placed"


def test_containers_are_spread_over_many_machines(world: World) -> None:
    count = 5 * CANDIDATES
    for number in range(count):
        world.state.apply(_machine(f"m{number}", slots=10), world.now)
    for number in range(3 * count):
        world.state.apply(_create(number, Resources()), world.now)
    assert set(Counter(places(world)).values()) == {3}


def test_a_create_looks_at_few_of_many_machines(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a create costs does not grow with the number of machines, nor of containers on them."""
    calls: Counter[str] = Counter()

    def count(owner: type, name: str) -> None:
        counted = getattr(owner, name)

        def call(*args: object) -> object:
            calls[name] += 1
            return counted(*args)

        monkeypatch.setattr(owner, name, call)

    machines = 12 * CANDIDATES
    for number in range(machines):
        world.state.apply(_machine(f"m{number}", slots=4), world.now)
    world.state.apply(_create(0, Resources()), world.now)
    count(Room, "fits")
    count(Rooms, "_make")
    for number in range(1, 3 * machines):
        calls.clear()
        world.state.apply(_create(number, Resources()), world.now)
        assert 0 < calls["fits"] <= CANDIDATES + 4
        assert 0 < calls["_make"] <= 2


def test_offered_machines_are_put_in_order_once(world: World) -> None:
    """A pass that offers many asks for their order for each container, while their loads change."""
    machines = [f"m{number}" for number in range(4 * CANDIDATES)]
    for name in machines:
        world.state.apply(_machine(name, slots=4), world.now)
    offered = _Offered(dict.fromkeys(machines[::2]))
    rooms = world.state.tables.rooms
    for number in range(len(machines)):
        found = rooms.candidates(Resources(), lambda _: True, among=offered)
        open_ = [room for process in offered if (room := rooms.get(process)) is not None]
        least = sorted((room.load_with(Resources()), room.process) for room in open_ if not room.draining)
        assert [room.process for room in found.rooms] == [process for _, process in least[:CANDIDATES]]
        if number == 0:
            offered.asked = 0
        world.state.apply(_create(number, Resources()), world.now)
        if number % 10 == 0:
            world.state.apply(commands.SetDraining(machine=machines[number], draining=True), world.now)
    assert offered.asked == len(machines) - 1, "by this test alone"


class _Offered(dict[str, None]):
    """Counts how often all machines of it were looked at."""

    asked = 0

    def __iter__(self) -> Iterator[str]:
        self.asked += 1
        return super().__iter__()


def test_candidates_fill_as_well_as_all_machines_do() -> None:
    """The machines that are compared leave no more room unused than a comparison with all of them."""
    random = Random(1)
    requests = [
        Resources(size=random.choice((1, 1, 1, 2, 4)), cpu=random.choice((0.0, 0.5, 2.0))) for _ in range(900)
    ]
    world = World()
    for number in range(4 * CANDIDATES):
        slots = 4 if number % 2 else 16
        world.state.apply(_machine(f"m{number}", slots=slots, cores=slots // 2), world.now)
    rooms = {room.process: room for room in world.state.tables.rooms}
    with_all = 0
    for number, requested in enumerate(requests):
        chosen = choose(rooms.values(), requested)
        if chosen is not None:
            rooms[chosen.process] = chosen.with_(requested)
            with_all += 1
        try:
            world.state.apply(_create(number, requested), world.now)
        except RefusedError:
            continue
    world.state.validate()
    assert len(world.state.tables.containers()) >= 0.98 * with_all
    most = max(room.load for room in world.state.tables.rooms)
    assert most <= 1


def _machine(process: str, slots: int, cores: int = 0) -> commands.TaskSetArrived:
    machine = MachineInfo(name=process, slots=slots, cores=cores)
    hello = Hello(version=CONTROL_VERSION, kind=TaskSetKind.CONTAINER, process=process, machine=machine)
    return commands.TaskSetArrived(hello=hello)


def _create(number: int, requested: Resources) -> commands.CreateContainer:
    return commands.CreateContainer(user="anna", tag=f"c{number}", resources=requested)
