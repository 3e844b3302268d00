"""``service list|type|call``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.ros.tools.exceptions import ToolError
from rce.ros.tools.graph import look, service_type
from rce.ros.tools.plain import as_json, as_yaml, read_fields

if TYPE_CHECKING:
    from rce.ros.tools.topics import Desk


async def list_services(desk: Desk) -> None:
    """Print all services but this tool's own."""
    services = (await look(desk.master)).services
    for service in sorted(services):
        if services[service] != [desk.node.name]:
            desk.show(service)


async def show_type(desk: Desk, service: str) -> None:
    """Print a service's type."""
    desk.show(await service_type(desk.node.resolve(service), desk.master))


async def call(desk: Desk, service: str, values: str, *, json: bool, timeout: float) -> None:
    """Call a service and print its response.

    Args:
        desk: What to work with.
        service: The service.
        values: The request's fields as YAML.
        json: JSON in place of YAML.
        timeout: Seconds.

    Raises:
        ToolError: There is no such service, or the values do not fit its request.
        ServiceError: There is no response.
    """
    name = desk.node.resolve(service)
    kind = desk.types.service(await service_type(name, desk.master))
    try:
        request = kind.request.new(**read_fields(values, kind.request))
    except ValueError as error:
        raise ToolError(f"the request for {name}: {error}") from error
    response = await desk.node.service_client(name, kind, persistent=False).call(request, timeout=timeout)
    desk.show(as_json(response) if json else as_yaml(response, whole=True).rstrip("\n"))
