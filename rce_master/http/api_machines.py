"""REST: draining of container machines."""

from __future__ import annotations

from rce_master.http import models
from rce_master.http.routes import Call, route_table
from rce_master.http.views import Views
from rce_master.state import commands

routes = route_table("machines")


@routes.route(
    "PUT",
    "/machines/{machine}/drain",
    "Give a machine no new containers and hand over those that it has",
    reply=models.MachinesOut,
    admin=True,
)
async def drain_machine(call: Call) -> models.MachinesOut:
    """Drain a machine, by its name or that of a task set."""
    return await _set(call, draining=True)


@routes.route(
    "DELETE",
    "/machines/{machine}/drain",
    "Let a machine take containers again",
    reply=models.MachinesOut,
    admin=True,
)
async def undrain_machine(call: Call) -> models.MachinesOut:
    """Cancel a drain."""
    return await _set(call, draining=False)


async def _set(call: Call, *, draining: bool) -> models.MachinesOut:
    machine, tables = call.path("machine"), call.services.state_service.tables
    await call.services.state_service.submit(commands.SetDraining(machine=machine, draining=draining))
    views = Views(tables, call.services.reconciler.usage)
    found = [s for s in tables.task_sets if machine in (s.process, s.machine.name)]
    return models.MachinesOut(machines=[views.machine(s) for s in found])
