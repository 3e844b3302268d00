"""``service list|type|call``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.ros.errors import ToolError
from rce.ros.tools.graph import look, service_type
from rce.ros.tools.plain import as_json, as_yaml, read_fields

if TYPE_CHECKING:
    from rce.ros.tools.topics import ToolContext


async def list_services(context: ToolContext) -> None:
    """Print all services except this tool's own."""
    services = (await look(context.master)).services
    for service in sorted(services):
        if services[service] != [context.node.name]:
            context.show(service)


async def show_type(context: ToolContext, service: str) -> None:
    """Print a service's type."""
    context.show(await service_type(context.node.resolve(service), context.master))


async def call(context: ToolContext, service: str, values: str, *, json: bool, timeout: float) -> None:
    """Call a service and print its response.

    Args:
        context: The node and the output.
        service: The service.
        values: The request's fields as YAML.
        json: JSON in place of YAML.
        timeout: Seconds.

    Raises:
        ToolError: The service does not exist, or the values do not fit its request.
        ServiceError: The call got no response.
    """
    name = context.node.resolve(service)
    kind = context.types.service(await service_type(name, context.master))
    try:
        request = kind.request.new(**read_fields(values, kind.request))
    except ValueError as error:
        raise ToolError(f"the request for {name}: {error}") from error
    response = await context.node.service_client(name, kind, persistent=False).call(request, timeout=timeout)
    context.show(as_json(response) if json else as_yaml(response, whole=True).rstrip("\n"))
