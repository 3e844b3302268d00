"""REST: lists of robots, containers and other objects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.http import models, spec_models
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.views import Views

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.state.records import Endpoint
    from rce_master.state.wiring_records import Link

routes = route_table("fleet")


@routes.route("GET", "/robots", "List robots", reply=models.RobotsOut, query=(OF_USER,))
async def list_robots(call: Call) -> models.RobotsOut:
    """List robots."""
    views = _views(call)
    return models.RobotsOut(
        robots=[views.robot(r) for r in call.services.state_service.tables.robots(call.scope)]
    )


@routes.route("GET", "/containers", "List containers", reply=spec_models.ContainersOut, query=(OF_USER,))
async def list_containers(call: Call) -> spec_models.ContainersOut:
    """List containers."""
    views = _views(call)
    found = call.services.state_service.tables.containers(call.scope)
    return spec_models.ContainersOut(containers=[views.container(c) for c in found])


@routes.route("GET", "/nodes", "List nodes", reply=spec_models.NodesOut, query=(OF_USER,))
async def list_nodes(call: Call) -> spec_models.NodesOut:
    """List nodes."""
    views = _views(call)
    found = call.services.state_service.tables.containers(call.scope)
    return spec_models.NodesOut(nodes=[node for c in found for node in views.nodes(c)])


@routes.route("GET", "/parameters", "List parameters", reply=spec_models.ParametersOut, query=(OF_USER,))
async def list_parameters(call: Call) -> spec_models.ParametersOut:
    """List parameters."""
    views = _views(call)
    found = call.services.state_service.tables.containers(call.scope)
    return spec_models.ParametersOut(parameters=[p for c in found for p in views.parameters(c)])


@routes.route("GET", "/interfaces", "List interfaces", reply=spec_models.InterfacesOut, query=(OF_USER,))
async def list_interfaces(call: Call) -> spec_models.InterfacesOut:
    """List interfaces."""
    views = _views(call)
    return spec_models.InterfacesOut(interfaces=[i for e in _endpoints(call) for i in views.interfaces(e)])


@routes.route("GET", "/connections", "List connections", reply=spec_models.ConnectionsOut, query=(OF_USER,))
async def list_connections(call: Call) -> spec_models.ConnectionsOut:
    """List connections."""
    views = _views(call)
    return spec_models.ConnectionsOut(
        connections=[c for link in _links(call) for c in views.connections(link)]
    )


@routes.route("GET", "/machines", "List task sets and machines", reply=models.MachinesOut, admin=True)
async def list_machines(call: Call) -> models.MachinesOut:
    """List task sets."""
    views = _views(call)
    return models.MachinesOut(
        machines=[views.machine(s) for s in call.services.state_service.tables.task_sets]
    )


def _views(call: Call) -> Views:
    return Views(call.services.state_service.tables, call.services.reconciler.usage)


def _endpoints(call: Call) -> Iterable[Endpoint]:
    tables = call.services.state_service.tables
    return tables.endpoints if call.scope is None else tables.endpoints.by("user", call.scope)


def _links(call: Call) -> Iterable[Link]:
    tables = call.services.state_service.tables
    if call.scope is None:
        return tables.links
    found = (
        link for e in tables.endpoints.by("user", call.scope) for link in tables.links.by("endpoint", e.id)
    )
    return {link.id: link for link in found}.values()
