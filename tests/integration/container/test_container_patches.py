"""Containers whose master sends what changed, and programs of the release before, which get wholes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.container_specs import ECHO
from support.containers import Machine, until

from rce.control.messages import CONTROL_VERSION, PatchSpec, PatchStatus, SpecWanted, Status, Welcome
from rce.control.model import PATCHES, EndpointContents, NodeState, SpecPatch
from rce.control.observed import ObservedStatus
from rce.model.specs import InterfaceSpec, Resources

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

BOX = "user/box"


@pytest.fixture
def machine(folder: Path) -> Iterator[Machine]:
    machine = Machine(folder, "process")
    yield machine
    machine.tidy()


def interface(tag: str) -> InterfaceSpec:
    return InterfaceSpec(tag=tag, type="PublisherInterface", message_type="std_msgs/String", addr=f"/{tag}")


def patch(base: int, *added: str, removed: tuple[str, ...] = ()) -> PatchSpec:
    return PatchSpec(
        patch=SpecPatch(
            id=BOX,
            base=base,
            revision=base + 1,
            interfaces=tuple(map(interface, added)),
            removed_interfaces=removed,
        )
    )


async def welcome(machine: Machine, *features: str) -> None:
    await machine.manager.handle(Welcome(version=CONTROL_VERSION, master="m", features=features))


async def has(machine: Machine, *tags: str) -> None:
    await until(
        lambda: (status := machine.status(BOX)) is not None and set(status.interfaces) == set(tags),
        what=lambda: f"{tags} are there: {machine.status(BOX)}",
    )


def added_up(machine: Machine) -> ObservedStatus:
    """Return what a master of this release knows by now."""
    observed: ObservedStatus | None = None
    for message in machine.told:
        if isinstance(message, Status):
            observed = ObservedStatus(message.status)
        elif isinstance(message, PatchStatus):
            assert observed is not None
            assert message.patch.status.number == observed.header.number + 1
            observed.patch(message.patch)
    assert observed is not None
    return observed


async def test_what_changed_goes_down_and_comes_up_alone(machine: Machine) -> None:
    async with machine.engine():
        await welcome(machine, PATCHES)
        await machine.put(BOX, 1, interfaces=tuple(map(interface, ("a", "b", "c"))))
        await has(machine, "a", "b", "c")
        machine.told.clear()
        machine.told.append(Status(status=machine.reported(BOX)))
        await machine.manager.handle(patch(1, "d"))
        await has(machine, "a", "b", "c", "d")
        await machine.manager.handle(patch(2, removed=("a", "b")))
        await has(machine, "c", "d")
        await until(lambda: machine.reported(BOX).revision == 3)
        changes = machine.of(PatchStatus)
        named = [set(one.patch.status.interfaces) for one in changes]
        assert set().union(*named) == {"d"}, "nothing is told again"
        assert added_up(machine).whole == machine.reported(BOX)
        assert not machine.of(SpecWanted)


async def test_a_patch_that_does_not_fit_is_asked_for_as_a_whole(machine: Machine) -> None:
    async with machine.engine():
        await welcome(machine, PATCHES)
        await machine.put(BOX, 1, interfaces=(interface("a"),))
        await has(machine, "a")
        await machine.manager.handle(patch(5, "b"))
        assert machine.of(SpecWanted) == [SpecWanted(id=BOX)]
        await machine.put(BOX, 6, interfaces=(interface("a"), interface("b")))
        await machine.manager.handle(patch(6, "c"))
        await has(machine, "a", "b", "c")


async def test_a_manager_that_died_in_between_is_followed_by_one_that_goes_on(machine: Machine) -> None:
    async with machine.managed():
        await welcome(machine, PATCHES)
        await machine.put(BOX, 1, interfaces=(interface("a"),))
        await has(machine, "a")
        await machine.manager.handle(patch(1, "b"))
        await has(machine, "a", "b")
        before = machine.reported(BOX).incarnation
    async with machine.engine():
        await welcome(machine, PATCHES)
        machine.told.clear()
        assert set(machine.reported(BOX).interfaces) == {"a", "b"}
        await machine.manager.handle(patch(2, "c"))
        assert machine.of(SpecWanted) == [SpecWanted(id=BOX)], "it was told of no base"
        await machine.put(BOX, 3, interfaces=tuple(map(interface, ("a", "b", "c"))))
        await machine.manager.handle(patch(3, "d"))
        await has(machine, "a", "b", "c", "d")
        assert machine.reported(BOX).incarnation == before, "the container went on"


async def test_an_environment_that_is_killed_begins_with_all_patches(machine: Machine) -> None:
    async with machine.engine():
        await welcome(machine, PATCHES)
        await machine.put(BOX, 1, interfaces=(interface("a"),))
        await has(machine, "a")
        await machine.manager.handle(patch(1, "b"))
        await has(machine, "a", "b")
        before = machine.reported(BOX).incarnation
        machine.manager._incarnations[before].kill()
        await until(lambda: machine.reported(BOX).incarnation not in ("", before))
        await machine.manager.handle(patch(2, "c"))
        await has(machine, "a", "b", "c")
        await until(lambda: set(added_up(machine).whole.interfaces) == {"a", "b", "c"})


@pytest.mark.parametrize("old", ["master", "environment and manager"])
async def test_programs_of_the_former_release_get_and_send_wholes(
    machine: Machine, old: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What either side does not announce, the other does not send; the container is the same."""
    if old != "master":
        monkeypatch.setattr("rce_container.incarnation.PATCHES", "unheard of")
    async with machine.engine():
        await welcome(machine, *(() if old == "master" else (PATCHES,)))
        await machine.put(BOX, 1, interfaces=(interface("a"),))
        await has(machine, "a")
        await machine.manager.handle(patch(1, "b"))
        await machine.manager.handle(patch(2, "c", removed=("a",)))
        await has(machine, "b", "c")
        assert not machine.of(PatchStatus)
        await until(lambda: machine.reported(BOX).revision == 3)
        assert machine.of(Status)[-1].status == machine.reported(BOX)


async def test_nodes_and_limits_change_by_patches(machine: Machine) -> None:
    async with machine.engine():
        await welcome(machine, PATCHES)
        await machine.put(BOX, 1, interfaces=(interface("a"),))
        early = EndpointContents(resources=Resources(cpu=0.5))  # while its processes start
        await machine.manager.handle(PatchSpec(patch=SpecPatch(id=BOX, base=1, revision=2, contents=early)))
        await has(machine, "a")
        contents = EndpointContents(resources=Resources(cpu=0.5), nodes=(ECHO,))
        await machine.manager.handle(
            PatchSpec(patch=SpecPatch(id=BOX, base=2, revision=3, contents=contents))
        )
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        await machine.manager.handle(patch(3, "b"))
        await has(machine, "a", "b")
        assert machine.reported_node(BOX, "echo").state is NodeState.RUNNING
        assert not machine.of(SpecWanted)
