"""What a client requested from the engine, to restore it after a reconnect. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar, assert_never

from msgspec.structs import replace

from rce.model import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParameter,
)

if TYPE_CHECKING:
    from collections.abc import Iterable


Item = TypeVar("Item")


class Desired:
    """Everything that was created and not removed.

    Invariant: what belongs to a container or an interface is forgotten with it; so what :meth:`restore`
    returns never names something that it does not make itself, unless another client made it.
    """

    def __init__(self) -> None:
        self.containers: dict[str, CreateContainer] = {}
        self.sizes: dict[str, ResizeContainer] = {}
        """By the tag of a container of ours; what several requests said, in one."""
        self.nodes: dict[tuple[str, str], AddNode] = {}
        """By container tag and node tag."""
        self.parameters: dict[tuple[str, str], SetParameter] = {}
        """By container tag and name."""
        self.interfaces: dict[tuple[str, str], AddInterface] = {}
        """By endpoint tag and interface tag."""
        self.connections: dict[frozenset[str], Connection] = {}
        """By the two interfaces' paths; which of them is named first means nothing."""

    def apply(self, request: Request) -> None:
        """Store a request that is sent to the engine."""
        match request:
            case CreateContainer():
                self.containers[request.tag] = request
            case ResizeContainer():
                self._resize(request)
            case DestroyContainer():
                self._forget_container(request.tag)
            case ConfigureComponents():
                self._configure(request)
            case ConfigureConnections():
                for item in request.disconnect:
                    self.connections.pop(frozenset((item.tag_a, item.tag_b)), None)
                for item in request.connect:
                    self.connections[frozenset((item.tag_a, item.tag_b))] = item
            case _:
                assert_never(request)

    def restore(self) -> list[Request]:
        """Return the requests that make everything again; the engine takes what is there already silently."""
        requests: list[Request] = [*self.containers.values(), *self.sizes.values()]
        if self.nodes or self.parameters or self.interfaces:
            requests.append(
                ConfigureComponents(
                    set_param=tuple(self.parameters.values()),
                    add_interfaces=tuple(self.interfaces.values()),
                    add_nodes=tuple(self.nodes.values()),
                )
            )
        if self.connections:
            requests.append(ConfigureConnections(connect=tuple(self.connections.values())))
        return requests

    def unrestored(self, request: Request) -> Request | None:
        """Return the part of an applied request that :meth:`restore` does not repeat; None if there is none.

        It consists of removals, and of new sizes of containers that other clients made.
        """
        match request:
            case CreateContainer():
                return None
            case ResizeContainer():
                return None if request.tag in self.containers else request
            case DestroyContainer():
                return request
            case ConfigureComponents():
                components = ConfigureComponents(
                    remove_nodes=request.remove_nodes,
                    remove_interfaces=request.remove_interfaces,
                    delete_param=request.delete_param,
                )
                return components if components != ConfigureComponents() else None
            case ConfigureConnections():
                return ConfigureConnections(disconnect=request.disconnect) if request.disconnect else None
            case _:
                assert_never(request)

    def undo(self) -> list[Request]:
        """Return the requests that remove everything, in an order in which each still finds what it names."""
        requests: list[Request] = []
        if self.connections:
            requests.append(ConfigureConnections(disconnect=tuple(self.connections.values())))
        components = ConfigureComponents(
            remove_nodes=tuple(
                RemoveNode(container=item.container, tag=item.node.tag) for item in self._outside(self.nodes)
            ),
            remove_interfaces=tuple(
                RemoveInterface(endpoint=item.endpoint, tag=item.interface.tag)
                for item in self._outside(self.interfaces)
            ),
            delete_param=tuple(
                DeleteParameter(container=item.container, name=item.parameter.name)
                for item in self._outside(self.parameters)
            ),
        )
        if components != ConfigureComponents():
            requests.append(components)
        requests += [DestroyContainer(tag=tag) for tag in self.containers]
        return requests

    def _outside(self, items: dict[tuple[str, str], Item]) -> Iterable[Item]:
        """Yield what is not removed with one of our containers."""
        return (item for (endpoint, _), item in items.items() if endpoint not in self.containers)

    def _resize(self, request: ResizeContainer) -> None:
        if request.tag not in self.containers:
            return  # the client that created it restores it
        before = self.sizes.get(request.tag)
        if before is not None:
            request = replace(request, changes=replace(before.changes, **request.changes.given()))
        self.sizes[request.tag] = request

    def _configure(self, request: ConfigureComponents) -> None:
        for node in request.remove_nodes:
            self.nodes.pop((node.container, node.tag), None)
        for removed in request.remove_interfaces:
            self.interfaces.pop((removed.endpoint, removed.tag), None)
            self._forget_connections(f"{removed.endpoint}/{removed.tag}")
        for deleted in request.delete_param:
            self.parameters.pop((deleted.container, deleted.name), None)
        for parameter in request.set_param:
            self.parameters[parameter.container, parameter.parameter.name] = parameter
        for interface in request.add_interfaces:
            self.interfaces[interface.endpoint, interface.interface.tag] = interface
        for added in request.add_nodes:
            self.nodes[added.container, added.node.tag] = added

    def _forget_container(self, tag: str) -> None:
        self.containers.pop(tag, None)
        self.sizes.pop(tag, None)
        _discard_of(self.nodes, tag)
        _discard_of(self.parameters, tag)
        _discard_of(self.interfaces, tag)
        self._forget_connections(f"{tag}/")

    def _forget_connections(self, place: str) -> None:
        """Forget the connections of an interface (a path) or of an endpoint (a tag and a slash)."""
        for pair in list(self.connections):
            if any(path == place or (place[-1] == "/" and path.startswith(place)) for path in pair):
                del self.connections[pair]


def merge_removals(requests: Iterable[Request]) -> list[Request]:
    """Return requests that :meth:`Desired.unrestored` returned as few requests, in their order."""
    merged: list[Request] = []
    for request in requests:
        last = merged[-1] if merged else None
        if isinstance(last, ConfigureComponents) and isinstance(request, ConfigureComponents):
            merged[-1] = ConfigureComponents(
                remove_nodes=last.remove_nodes + request.remove_nodes,
                remove_interfaces=last.remove_interfaces + request.remove_interfaces,
                delete_param=last.delete_param + request.delete_param,
            )
        elif isinstance(last, ConfigureConnections) and isinstance(request, ConfigureConnections):
            merged[-1] = ConfigureConnections(disconnect=last.disconnect + request.disconnect)
        else:
            merged.append(request)
    return merged


def _discard_of(items: dict[tuple[str, str], Item], endpoint: str) -> None:
    for key in [key for key in items if key[0] == endpoint]:
        del items[key]
