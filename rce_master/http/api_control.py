"""REST: control. The same requests as clients make over their WebSocket, with the same checks and answers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from rce.model import (
    AddInterface,
    AddNode,
    Component,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    Item,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParameter,
    SpecError,
)
from rce.web.openapi import Query
from rce_master.exceptions import InvalidRequestError
from rce_master.http import spec_models as models
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.spec_models import SPELLING
from rce_master.requests import commands_of

if TYPE_CHECKING:
    from rce_master.http.model import Model

T = TypeVar("T", bound="Request | Item")

routes = route_table("control")

_QUERY = (OF_USER,)


async def _do(call: Call, request: Request | Component) -> None:
    """Carry out a request.

    Raises:
        Refused: The state does not allow it.
        StoreError: It could not be stored.
    """
    (command,) = commands_of(request, call.owner)
    await call.submit(command)


def _read(request: type[T], data: dict[str, Any]) -> T:
    """Read a request in the spelling of this API.

    Raises:
        InvalidRequestError: It is not valid.
    """
    try:
        return SPELLING.read(request, data)
    except SpecError as error:
        raise InvalidRequestError(str(error)) from error


def _sent(body: Model) -> dict[str, Any]:
    """Return the fields that a body contains, without those that it leaves out."""
    return body.model_dump(exclude_unset=True)


@routes.route(
    "POST",
    "/containers",
    "Make a container",
    body=models.ContainerIn,
    status=204,
    query=_QUERY,
    keyed=True,
)
async def create_container(call: Call) -> None:
    """Make a container."""
    await _do(call, _read(CreateContainer, _sent(call.read(models.ContainerIn))))


@routes.route(
    "PATCH",
    "/containers/{container}",
    "Change what a container may use, while it runs",
    body=models.ResizeIn,
    status=204,
    query=_QUERY,
)
async def resize_container(call: Call) -> None:
    """Resize a container."""
    data = _sent(call.read(models.ResizeIn))
    await _do(call, _read(ResizeContainer, {"container": call.path("container"), **data}))


@routes.route("DELETE", "/containers/{container}", "Destroy a container", status=204, query=_QUERY)
async def destroy_container(call: Call) -> None:
    """Destroy a container."""
    await _do(call, _read(DestroyContainer, {"container": call.path("container")}))


@routes.route(
    "POST",
    "/containers/{container}/nodes",
    "Start a node",
    body=models.NodeIn,
    status=204,
    query=_QUERY,
    keyed=True,
)
async def add_node(call: Call) -> None:
    """Start a node."""
    data = _sent(call.read(models.NodeIn))
    await _do(call, _read(AddNode, {"container": call.path("container"), **data}))


@routes.route("DELETE", "/containers/{container}/nodes/{node}", "Stop a node", status=204, query=_QUERY)
async def remove_node(call: Call) -> None:
    """Stop a node."""
    data = {"container": call.path("container"), "tag": call.path("node")}
    await _do(call, _read(RemoveNode, data))


@routes.route(
    "PUT",
    "/containers/{container}/parameters",
    "Set a parameter",
    body=models.ParameterIn,
    status=204,
    query=_QUERY,
)
async def set_parameter(call: Call) -> None:
    """Set a parameter."""
    data = _sent(call.read(models.ParameterIn))
    await _do(call, _read(SetParameter, {"container": call.path("container"), **data}))


@routes.route(
    "DELETE",
    "/containers/{container}/parameters",
    "Delete a parameter",
    status=204,
    query=(OF_USER, Query(name="name", description="Which one.", required=True)),
)
async def delete_parameter(call: Call) -> None:
    """Delete a parameter."""
    data = {"container": call.path("container"), "name": call.query("name")}
    await _do(call, _read(DeleteParameter, data))


@routes.route(
    "POST",
    "/endpoints/{endpoint}/interfaces",
    "Make an interface of a robot or container",
    body=models.InterfaceIn,
    status=204,
    query=_QUERY,
    keyed=True,
)
async def add_interface(call: Call) -> None:
    """Make an interface."""
    data = _sent(call.read(models.InterfaceIn))
    await _do(call, _read(AddInterface, {"endpoint": call.path("endpoint"), **data}))


@routes.route(
    "DELETE",
    "/endpoints/{endpoint}/interfaces/{interface}",
    "Remove an interface with its connections",
    status=204,
    query=_QUERY,
)
async def remove_interface(call: Call) -> None:
    """Remove an interface."""
    data = {"endpoint": call.path("endpoint"), "tag": call.path("interface")}
    await _do(call, _read(RemoveInterface, data))


@routes.route(
    "POST",
    "/connections",
    "Join two interfaces",
    body=models.ConnectionIn,
    status=204,
    query=_QUERY,
    keyed=True,
)
async def connect(call: Call) -> None:
    """Join two interfaces."""
    pair = _sent(call.read(models.ConnectionIn))
    await _do(call, ConfigureConnections(connect=(_read(Connection, pair),)))


@routes.route(
    "DELETE",
    "/connections",
    "Part two interfaces",
    status=204,
    query=(
        OF_USER,
        Query(name="tag_a", description="ENDPOINT/INTERFACE", required=True),
        Query(name="tag_b", description="ENDPOINT/INTERFACE", required=True),
    ),
)
async def disconnect(call: Call) -> None:
    """Part two interfaces."""
    pair = {"tag_a": call.query("tag_a"), "tag_b": call.query("tag_b")}
    await _do(call, ConfigureConnections(disconnect=(_read(Connection, pair),)))
