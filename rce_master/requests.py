"""Converts users' requests to commands on the state."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any, assert_never

from rce.model import Component, Request, requests
from rce.protocol import MessageError, read_request
from rce_master.state import commands

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce.control import ClientRequest


def count_items(request: ClientRequest) -> int:
    """Count the nodes, interfaces, ... in a client's request, without reading them."""
    content = request.content
    if content is not None:
        lists: Any = [getattr(content, name) for name in content.__struct_fields__ if name != "faults"]
    else:
        lists = request.data.values() if isinstance(request.data, dict) else ()
    return sum(len(items) for items in lists if isinstance(items, list | tuple))


def read(user: str, request: ClientRequest) -> tuple[list[commands.Request], list[str]]:
    """Read a client's request. Task sets of the previous release send it in the client's form.

    Returns:
        The commands in the order in which they are to be done, and a text for each item that cannot be read.
    """
    content = request.content
    if content is None:
        try:
            content = read_request(request.type, request.data)
        except MessageError as error:
            return [], [f"{request.type}: {error}"]
    faults = getattr(content, "faults", ())
    return list(commands_of(content, user)), [f"{request.type}: {fault}" for fault in faults]


def ids_of(command: commands.Request) -> dict[str, str]:
    """Return what a command is about, for programs; see :class:`rce.control.messages.RequestFault`."""
    match command:
        case commands.CreateContainer() | commands.ResizeContainer() | commands.DestroyContainer():
            ids = {"container": command.tag}
        case commands.AddNode():
            ids = {"container": command.container, "node": command.node.tag}
        case commands.RemoveNode():
            ids = {"container": command.container, "node": command.tag}
        case commands.SetParameter() | commands.DeleteParameter():
            ids = {"container": command.container, "parameter": command.name}
        case commands.AddInterface():
            ids = {"endpoint": command.endpoint, "interface": command.interface.tag}
        case commands.RemoveInterface():
            ids = {"endpoint": command.endpoint, "interface": command.tag}
        case commands.Connect() | commands.Disconnect():
            ids = {"a": command.tag_a, "b": command.tag_b}
        case _:
            assert_never(command)
    return ids


def commands_of(request: Request | Component, user: str) -> Iterator[commands.Request]:
    """Return the commands of a request, in the order in which they are to be done.

    Removals come first, so that one request can replace an object; parameters are set and interfaces made
    before nodes start, so that a node finds them.

    Args:
        request: The request.
        user: The requesting user.
    """
    match request:
        case requests.ConfigureComponents():
            items: list[Component] = [
                *request.remove_nodes,
                *request.remove_interfaces,
                *request.delete_param,
                *request.set_param,
                *request.add_interfaces,
                *request.add_nodes,
            ]
            yield from (_command(item, user) for item in items)
        case requests.ConfigureConnections():
            for pair in request.disconnect:
                yield commands.Disconnect(user=user, tag_a=pair.tag_a, tag_b=pair.tag_b)
            for pair in request.connect:
                yield commands.Connect(user=user, tag_a=pair.tag_a, tag_b=pair.tag_b)
        case requests.CreateContainer() | requests.ResizeContainer() | requests.DestroyContainer():
            yield _command(request, user)
        case (
            requests.AddNode() | requests.RemoveNode() | requests.AddInterface() | requests.RemoveInterface()
        ):
            yield _command(request, user)
        case requests.SetParameter() | requests.DeleteParameter():
            yield _command(request, user)
        case _:
            assert_never(request)


@singledispatch
def _command(item: object, user: str) -> commands.Request:
    raise TypeError(f"{type(item).__name__} of {user} is not a request")


@_command.register
def _(item: requests.CreateContainer, user: str) -> commands.Request:
    return commands.CreateContainer(user=user, tag=item.tag, resources=item.resources, wait=item.wait)


@_command.register
def _(item: requests.ResizeContainer, user: str) -> commands.Request:
    return commands.ResizeContainer(user=user, tag=item.tag, changes=item.changes)


@_command.register
def _(item: requests.DestroyContainer, user: str) -> commands.Request:
    return commands.DestroyContainer(user=user, tag=item.tag)


@_command.register
def _(item: requests.AddNode, user: str) -> commands.Request:
    return commands.AddNode(user=user, container=item.container, node=item.node)


@_command.register
def _(item: requests.RemoveNode, user: str) -> commands.Request:
    return commands.RemoveNode(user=user, container=item.container, tag=item.tag)


@_command.register
def _(item: requests.AddInterface, user: str) -> commands.Request:
    return commands.AddInterface(user=user, endpoint=item.endpoint, interface=item.interface)


@_command.register
def _(item: requests.RemoveInterface, user: str) -> commands.Request:
    return commands.RemoveInterface(user=user, endpoint=item.endpoint, tag=item.tag)


@_command.register
def _(item: requests.SetParameter, user: str) -> commands.Request:
    name, value = item.parameter.name, item.parameter.value
    return commands.SetParameter(user=user, container=item.container, name=name, value=value)


@_command.register
def _(item: requests.DeleteParameter, user: str) -> commands.Request:
    return commands.DeleteParameter(user=user, container=item.container, name=item.name)
