"""REST: draining of machines, task sets and masters, and moves of single containers."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from rce_master.http import models
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.views import Views
from rce_master.state import commands

if TYPE_CHECKING:
    from rce_master.leadership.drains import MasterDrains

routes = route_table("machines")


@routes.route(
    "PUT",
    "/machines/{machine}/drain",
    "Give a machine no new containers and robots, and hand over those that it has; or the lead of a master",
    reply=models.DrainOut,
    admin=True,
)
async def drain_machine(call: Call) -> models.DrainOut:
    """Drain a machine, by its name or that of a task set; or a master, by its name."""
    return await _set(call, draining=True)


@routes.route(
    "DELETE",
    "/machines/{machine}/drain",
    "Let a machine take containers and robots again, or a master the lead",
    reply=models.DrainOut,
    admin=True,
)
async def undrain_machine(call: Call) -> models.DrainOut:
    """Cancel a drain."""
    return await _set(call, draining=False)


@routes.route(
    "PUT",
    "/containers/{container}/machine",
    "Have a container handed over to another machine while it runs",
    body=models.MoveIn,
    status=202,
    admin=True,
    query=(OF_USER,),
)
async def move_container(call: Call) -> None:
    """Begin a move; the events ``container_moved`` and ``container_stays`` tell how it ended."""
    machine, tag = call.read(models.MoveIn).machine, call.path("container")
    await call.services.state_service.submit(
        commands.MoveContainer(user=call.controlled_owner, tag=tag, machine=machine)
    )


@routes.route(
    "GET",
    "/masters",
    "List the masters, if the engine has several",
    reply=models.MastersOut,
    admin=True,
    errors=(503,),
)
async def list_masters(call: Call) -> models.MastersOut:
    """List the masters."""
    drains = call.services.drains
    return models.MastersOut(masters=[] if drains is None else await _shown(drains))


async def _shown(drains: MasterDrains, name: str = "") -> list[models.MasterOut]:
    """Show all masters, or the one of a name."""
    return [models.MasterOut(**asdict(one)) for one in await drains.masters() if name in ("", one.name)]


async def _set(call: Call, *, draining: bool) -> models.DrainOut:
    machine, tables = call.path("machine"), call.services.state_service.tables
    drains = call.services.drains
    if drains is not None:
        is_machine = any(machine in (s.process, s.machine.name) for s in tables.task_sets)
        if master := await drains.find(machine, by_machine=not is_machine):
            await drains.set_drained(master, drained=draining)
            return models.DrainOut(machines=[], masters=await _shown(drains, master))
    await call.services.state_service.submit(commands.SetDraining(machine=machine, draining=draining))
    views = Views(tables, call.services.reconciler.usage)
    found = [s for s in tables.task_sets if machine in (s.process, s.machine.name)]
    return models.DrainOut(machines=[views.machine(s) for s in found], masters=[])
