"""Empties machines and moves containers in a :class:`~support.master_world.World`, and sees what is where."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from rce.control.model import EndpointState, EndpointStatus, LinkAddress
from rce_master.state import commands

if TYPE_CHECKING:
    from rce_master.state.changes import Changes
    from support.master_world import World
    from support.parts import StatusParts


def drain(world: World, machine: str = "m1", *, undo: bool = False) -> Changes:
    return world.do(commands.SetDraining(machine=machine, draining=not undo))


def move(world: World, tag: str = "c", machine: str = "m2") -> Changes:
    return world.do(commands.MoveContainer(user="anna", tag=tag, machine=machine))


def report(
    world: World,
    tag: str,
    process: str,
    state: EndpointState = EndpointState.RUNNING,
    **fields: Unpack[StatusParts],
) -> Changes:
    fields.setdefault("address", LinkAddress(machine=process, unix=f"/{process}/{tag}"))
    return world.report(process, EndpointStatus(id=f"anna/{tag}", revision=1, state=state, **fields))


def at(world: World, tag: str) -> str:
    return world.state.tables.endpoints[f"anna/{tag}"].task_set


def moves(world: World) -> dict[str, str]:
    return {one.id.partition("/")[2]: one.to for one in world.state.tables.moves}


def kinds(changes: Changes) -> list[str]:
    return [state_event.kind for state_event in changes.events]
