"""REST: control. The same requests as clients make over their WebSocket, with the same checks and answers."""

from __future__ import annotations

import re
from typing import Any

from rce.web.openapi import Query
from rce_master import requests
from rce_master.exceptions import InvalidRequestError
from rce_master.http import models
from rce_master.http.routes import OF_USER, Call, route_table

routes = route_table("control")

_QUERY = (OF_USER,)
_FAULT = re.compile(r"^([A-Z]{2}): data\.(?:\w+\[\d+\]\.|containerData\.)?(\w+)")
"""A fault in a client's message, up to the key that is wrong."""
_NAMES = {
    "nodeTag": "tag",
    "interfaceTag": "tag",
    "endpointTag": "endpoint",
    "interfaceType": "type",
    "className": "cls",
}
"""What keys of the messages are called here, if it is not only written another way."""


async def _request(call: Call, kind: str, data: dict[str, Any]) -> None:
    """Do a client request.

    Raises:
        Refused: It was not done.
        StoreError: It could not be stored.
    """
    wanted, faults = requests.read(call.owner, kind, data)
    if faults:
        raise InvalidRequestError("; ".join(_FAULT.sub(_place, fault) for fault in faults))
    for outcome in await call.services.state_service.submit_all(wanted):
        if outcome is not None:
            raise outcome


@routes.route("POST", "/containers", "Make a container", body=models.ContainerIn, status=204, query=_QUERY)
async def create_container(call: Call) -> None:
    """Make a container."""
    body = call.read(models.ContainerIn)
    data = {_camel(key): value for key, value in body.model_dump(exclude={"tag"}).items()}
    await _request(call, "CC", {"containerTag": body.tag, "containerData": data})


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
    data = call.read(models.ResizeIn).model_dump(exclude_none=True)
    await _request(call, "RC", {"containerTag": call.path("container"), "containerData": data})


@routes.route("DELETE", "/containers/{container}", "Destroy a container", status=204, query=_QUERY)
async def destroy_container(call: Call) -> None:
    """Destroy a container."""
    await _request(call, "DC", {"containerTag": call.path("container")})


@routes.route(
    "POST", "/containers/{container}/nodes", "Start a node", body=models.NodeIn, status=204, query=_QUERY
)
async def add_node(call: Call) -> None:
    """Start a node."""
    body = call.read(models.NodeIn)
    rest = {_camel(key): value for key, value in body.model_dump(exclude={"tag"}).items()}
    item = {"containerTag": call.path("container"), "nodeTag": body.tag, **rest}
    await _request(call, "CN", {"addNodes": [item]})


@routes.route("DELETE", "/containers/{container}/nodes/{node}", "Stop a node", status=204, query=_QUERY)
async def remove_node(call: Call) -> None:
    """Stop a node."""
    item = {"containerTag": call.path("container"), "nodeTag": call.path("node")}
    await _request(call, "CN", {"removeNodes": [item]})


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
    body = call.read(models.ParameterIn)
    item = {"containerTag": call.path("container"), "name": body.name, "value": body.value}
    await _request(call, "CN", {"setParam": [item]})


@routes.route(
    "DELETE",
    "/containers/{container}/parameters",
    "Delete a parameter",
    status=204,
    query=(OF_USER, Query(name="name", description="Which one.", required=True)),
)
async def delete_parameter(call: Call) -> None:
    """Delete a parameter."""
    item = {"containerTag": call.path("container"), "name": call.query("name")}
    await _request(call, "CN", {"deleteParam": [item]})


@routes.route(
    "POST",
    "/endpoints/{endpoint}/interfaces",
    "Make an interface of a robot or container",
    body=models.InterfaceIn,
    status=204,
    query=_QUERY,
)
async def add_interface(call: Call) -> None:
    """Make an interface."""
    body = call.read(models.InterfaceIn)
    item = {
        "endpointTag": call.path("endpoint"),
        "interfaceTag": body.tag,
        "interfaceType": body.type,
        "className": body.cls,
        "addr": body.addr,
    }
    await _request(call, "CN", {"addInterfaces": [item]})


@routes.route(
    "DELETE",
    "/endpoints/{endpoint}/interfaces/{interface}",
    "Remove an interface with its connections",
    status=204,
    query=_QUERY,
)
async def remove_interface(call: Call) -> None:
    """Remove an interface."""
    item = {"endpointTag": call.path("endpoint"), "interfaceTag": call.path("interface")}
    await _request(call, "CN", {"removeInterfaces": [item]})


@routes.route(
    "POST", "/connections", "Join two interfaces", body=models.ConnectionIn, status=204, query=_QUERY
)
async def connect(call: Call) -> None:
    """Join two interfaces."""
    body = call.read(models.ConnectionIn)
    await _request(call, "CX", {"connect": [{"tagA": body.tag_a, "tagB": body.tag_b}]})


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
    pair = {"tagA": call.query("tag_a"), "tagB": call.query("tag_b")}
    await _request(call, "CX", {"disconnect": [pair]})


def _place(fault: re.Match[str]) -> str:
    """Say where a fault is in words of this API."""
    kind, key = fault.groups()
    if key == "containerTag":
        return "tag" if kind == "CC" else "container"
    return _NAMES.get(key) or re.sub(r"(?=[A-Z])", "_", key).lower()


def _camel(key: str) -> str:
    first, *rest = key.split("_")
    return first + "".join(part.capitalize() for part in rest)
