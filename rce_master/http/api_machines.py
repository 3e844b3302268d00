"""REST: draining of machines and task sets, and moves of single containers."""

from __future__ import annotations

from rce_master.http import models
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.views import Views
from rce_master.state import commands

routes = route_table("machines")


@routes.route(
    "PUT",
    "/machines/{machine}/drain",
    "Give a machine no new containers and robots, and hand over those that it has",
    reply=models.MachinesOut,
    admin=True,
)
async def drain_machine(call: Call) -> models.MachinesOut:
    """Drain a machine, by its name or that of a task set."""
    return await _set(call, draining=True)


@routes.route(
    "DELETE",
    "/machines/{machine}/drain",
    "Let a machine take containers and robots again",
    reply=models.MachinesOut,
    admin=True,
)
async def undrain_machine(call: Call) -> models.MachinesOut:
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


async def _set(call: Call, *, draining: bool) -> models.MachinesOut:
    machine, tables = call.path("machine"), call.services.state_service.tables
    await call.services.state_service.submit(commands.SetDraining(machine=machine, draining=draining))
    views = Views(tables, call.services.reconciler.usage)
    found = [s for s in tables.task_sets if machine in (s.process, s.machine.name)]
    return models.MachinesOut(machines=[views.machine(s) for s in found])
