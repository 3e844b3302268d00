"""Turns a client's request (``CC``, ``RC``, ``DC``, ``CN``, ``CX``) into commands on the state."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any, assert_never

from rce.model.quantities import read_bandwidth, read_cores, read_memory
from rce.model.specs import InterfaceSpec, Network, NodeSpec, Resources, RestartPolicy
from rce.protocol import messages
from rce.protocol.exceptions import MessageError
from rce.protocol.reading import read_request
from rce_master.state import commands

if TYPE_CHECKING:
    from collections.abc import Iterator

    from msgspec import Struct


def count_items(data: Any) -> int:
    """Count, without reading them, the nodes, interfaces, ... that a request is about."""
    lists = data.values() if isinstance(data, dict) else ()
    return sum(len(items) for items in lists if isinstance(items, list))


def read(user: str, kind: str, data: Any) -> tuple[list[commands.Request], list[str]]:
    """Read a request.

    What a ``CN`` or ``CX`` removes is removed first, so that one message can replace something; parameters
    are set and interfaces made before nodes start, so that a node finds them.

    Args:
        user: Who asks.
        kind: ``CC``, ``RC``, ``DC``, ``CN`` or ``CX``.
        data: The message's ``data``, as it came.

    Returns:
        The commands in the order in which they are to be done, and a text for each item that cannot be read.
    """
    try:
        message = read_request(kind, data)
    except MessageError as error:
        return [], [f"{kind}: {error}"]
    faults = getattr(message, "faults", ())
    return list(_commands(message, user)), [f"{kind}: {fault}" for fault in faults]


def _commands(message: messages.Request, user: str) -> Iterator[commands.Request]:
    items: list[Struct]
    match message:
        case messages.ConfigureComponents():
            items = [
                *message.remove_nodes,
                *message.remove_interfaces,
                *message.delete_param,
                *message.set_param,
                *message.add_interfaces,
                *message.add_nodes,
            ]
            yield from (_command(item, user) for item in items)
        case messages.ConfigureConnections():
            for pair in message.disconnect:
                yield commands.Disconnect(user=user, tag_a=pair.tag_a, tag_b=pair.tag_b)
            for pair in message.connect:
                yield commands.Connect(user=user, tag_a=pair.tag_a, tag_b=pair.tag_b)
        case messages.CreateContainer() | messages.ResizeContainer() | messages.DestroyContainer():
            yield _command(message, user)
        case _:
            assert_never(message)


@singledispatch
def _command(item: Struct, user: str) -> commands.Request:
    raise TypeError(f"{type(item).__name__} of {user} is not a request")


@_command.register
def _(item: messages.CreateContainer, user: str) -> commands.Request:
    data = item.container_data
    return commands.CreateContainer(
        user=user, tag=item.container_tag, resources=resources(data), wait=data.wait
    )


@_command.register
def _(item: messages.ResizeContainer, user: str) -> commands.Request:
    data = item.container_data
    return commands.ResizeContainer(
        user=user,
        tag=item.container_tag,
        size=data.size,
        cpu=None if data.cpu is None else read_cores(data.cpu),
        memory=None if data.memory is None else read_memory(data.memory),
        bandwidth=None if data.bandwidth is None else read_bandwidth(data.bandwidth),
    )


@_command.register
def _(item: messages.DestroyContainer, user: str) -> commands.Request:
    return commands.DestroyContainer(user=user, tag=item.container_tag)


@_command.register
def _(item: messages.AddNode, user: str) -> commands.Request:
    return commands.AddNode(user=user, container=item.container_tag, node=node_spec(item))


@_command.register
def _(item: messages.RemoveNode, user: str) -> commands.Request:
    return commands.RemoveNode(user=user, container=item.container_tag, tag=item.node_tag)


@_command.register
def _(item: messages.AddInterface, user: str) -> commands.Request:
    interface = InterfaceSpec(
        tag=item.interface_tag, type=item.interface_type, message_type=item.message_type, addr=item.addr
    )
    return commands.AddInterface(user=user, endpoint=item.endpoint_tag, interface=interface)


@_command.register
def _(item: messages.RemoveInterface, user: str) -> commands.Request:
    return commands.RemoveInterface(user=user, endpoint=item.endpoint_tag, tag=item.interface_tag)


@_command.register
def _(item: messages.SetParam, user: str) -> commands.Request:
    return commands.SetParameter(user=user, container=item.container_tag, name=item.name, value=item.value)


@_command.register
def _(item: messages.DeleteParam, user: str) -> commands.Request:
    return commands.DeleteParameter(user=user, container=item.container_tag, name=item.name)


def resources(data: messages.ContainerData) -> Resources:
    """Read what a container asks for."""
    return Resources(
        group=data.group,
        group_ip=data.group_ip,
        network=Network.GROUP if data.joins_group else Network(data.network or Network.NONE.value),
        image=data.image,
        size=max(1, data.size),
        cpu=read_cores(data.cpu),
        memory=read_memory(data.memory),
        bandwidth=read_bandwidth(data.bandwidth),
        special_features=data.features,
    )


def node_spec(item: messages.AddNode) -> NodeSpec:
    """Read a node."""
    return NodeSpec(
        tag=item.node_tag,
        pkg=item.pkg,
        exe=item.exe,
        args=item.args,
        name=item.name,
        namespace=item.namespace,
        restart=RestartPolicy(item.restart),
        max_restarts=item.max_restarts,
        after=item.after,
        heartbeat=item.heartbeat,
        heartbeat_timeout=item.heartbeat_timeout,
    )
