"""REST: lists of robots, containers and other objects."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rce_master.http import models, spec_models
from rce_master.http.paging import ALONE, PAGE, Listing, Span, answer, keys_of, keys_of_users
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.views import Views

if TYPE_CHECKING:
    from collections.abc import Callable

    from aiohttp import web

    from rce_master.http.model import Model
    from rce_master.state.records import Endpoint
    from rce_master.state.tables import Tables

routes = route_table("fleet")

_QUERY = (OF_USER, *PAGE)
Items = Iterable[tuple[str, "Model"]]


@routes.route("GET", "/robots", "List robots", reply=models.RobotsOut, query=_QUERY)
async def list_robots(call: Call) -> web.Response:
    """List robots."""
    tables, views, scope = _tables(call), _views(call), call.scope

    def items(key: str, span: Span) -> Items:
        robot = tables.robot(key)
        return [] if robot is None else [(name, views.robot(robot)) for name in span.of(ALONE)]

    listing = Listing(
        name="robots",
        whole=lambda: [robot.id for robot in tables.robots(scope)],
        keys=keys_of_users(tables, tables.endpoints, "robots_of", scope),
        items=items,
    )
    return await answer(call, listing)


@routes.route("GET", "/containers", "List containers", reply=spec_models.ContainersOut, query=_QUERY)
async def list_containers(call: Call) -> web.Response:
    """List containers."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        container = tables.container(key)
        return [] if container is None else [(name, views.container(container)) for name in span.of(ALONE)]

    return await _of_containers(call, "containers", items)


@routes.route("GET", "/nodes", "List nodes", reply=spec_models.NodesOut, query=_QUERY)
async def list_nodes(call: Call) -> web.Response:
    """List nodes."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        container = tables.container(key)
        tags = [] if container is None else span.of(container.nodes)
        return [] if container is None else zip(tags, views.nodes(container, tags), strict=True)

    return await _of_containers(call, "nodes", items)


@routes.route("GET", "/parameters", "List parameters", reply=spec_models.ParametersOut, query=_QUERY)
async def list_parameters(call: Call) -> web.Response:
    """List parameters."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        container = tables.container(key)
        if container is None:
            return []
        return [(name, views.parameter(container, name)) for name in span.of(container.parameters)]

    return await _of_containers(call, "parameters", items)


@routes.route("GET", "/interfaces", "List interfaces", reply=spec_models.InterfacesOut, query=_QUERY)
async def list_interfaces(call: Call) -> web.Response:
    """List interfaces."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        endpoint = tables.endpoints.get(key)
        if endpoint is None:
            return []
        there = {one.spec.tag: one for one in tables.interfaces.by("endpoint", key)}
        return ((tag, views.interface(endpoint, there[tag])) for tag in span.of(there))

    return await _of_endpoints(call, "interfaces", items)


@routes.route("GET", "/connections", "List connections", reply=spec_models.ConnectionsOut, query=_QUERY)
async def list_connections(call: Call) -> web.Response:
    """List connections."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        # Each is an item of one of its ends only.
        there = {str(one.id): one for one in tables.connections.by("endpoint", key) if one.a == key}
        return ((name, views.connection(there[name])) for name in span.of(there))

    return await _of_endpoints(call, "connections", items)


@routes.route(
    "GET", "/machines", "List task sets and machines", reply=models.MachinesOut, query=PAGE, admin=True
)
async def list_machines(call: Call) -> web.Response:
    """List task sets."""
    tables, views = _tables(call), _views(call)

    def items(key: str, span: Span) -> Items:
        task_set = tables.task_sets.get(key)
        return [] if task_set is None else [(name, views.machine(task_set)) for name in span.of(ALONE)]

    listing = Listing(
        name="machines",
        whole=lambda: [one.process for one in tables.task_sets],
        keys=keys_of(tables.task_sets),
        items=items,
    )
    return await answer(call, listing)


async def _of_containers(call: Call, name: str, items: Callable[[str, Span], Items]) -> web.Response:
    tables, scope = _tables(call), call.scope
    listing = Listing(
        name=name,
        whole=lambda: [container.id for container in tables.containers(scope)],
        keys=keys_of_users(tables, tables.endpoints, "containers_of", scope),
        items=items,
    )
    return await answer(call, listing)


async def _of_endpoints(call: Call, name: str, items: Callable[[str, Span], Items]) -> web.Response:
    tables, scope = _tables(call), call.scope

    def whole() -> list[str]:
        found: Iterable[Endpoint] = tables.endpoints if scope is None else tables.endpoints.by("user", scope)
        return [endpoint.id for endpoint in found]

    listing = Listing(
        name=name,
        whole=whole,
        keys=keys_of_users(tables, tables.endpoints, "user", scope),
        items=items,
    )
    return await answer(call, listing)


def _tables(call: Call) -> Tables:
    return call.services.state_service.tables


def _views(call: Call) -> Views:
    return Views(_tables(call), call.services.reconciler.usage)
