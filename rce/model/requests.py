"""Requests of users: typed, and the same from the client's library to the master's state.

A request is parsed once (:mod:`rce.model.spelling`), where a user's text comes in. From there on it is one of
these types, also on the control channel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, TypeAlias

from msgspec import Struct

from rce.model import written
from rce.model.faults import FaultCode, FieldFault
from rce.model.names import Form
from rce.model.specs import InterfaceSpec, Network, NodeSpec, ParameterSpec, ResourceChanges, Resources
from rce.model.written import AsWritten

if TYPE_CHECKING:
    from collections.abc import Iterator

_NAME = AsWritten(written.Name)
_PATH = AsWritten(written.InterfacePath)


class CreateContainer(Struct, frozen=True, kw_only=True, omit_defaults=True, tag=True, tag_field="t"):
    """Make a container."""

    tag: Annotated[str, _NAME]
    resources: Resources = Resources()
    wait: Annotated[bool, AsWritten(bool)] = False
    """Wait for a machine with room if there is none now; otherwise that is an error."""


class ResizeContainer(Struct, frozen=True, kw_only=True, omit_defaults=True, tag=True, tag_field="t"):
    """Change the resources of a container while it runs."""

    tag: Annotated[str, _NAME]
    changes: ResourceChanges


class DestroyContainer(Struct, frozen=True, kw_only=True, omit_defaults=True, tag=True, tag_field="t"):
    """Remove a container and everything in it."""

    tag: Annotated[str, _NAME]


class AddNode(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Start a node in a container."""

    container: Annotated[str, _NAME]
    node: NodeSpec


class RemoveNode(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Stop a node."""

    container: Annotated[str, _NAME]
    tag: Annotated[str, _NAME]


class AddInterface(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Make an interface of a container or a robot."""

    endpoint: Annotated[str, _NAME]
    interface: InterfaceSpec

    @property
    def path(self) -> str:
        """``ENDPOINT/INTERFACE``."""
        return f"{self.endpoint}/{self.interface.tag}"


class RemoveInterface(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Remove an interface and its connections."""

    endpoint: Annotated[str, _NAME]
    tag: Annotated[str, _NAME]


class SetParameter(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Set a parameter of a container."""

    container: Annotated[str, _NAME]
    parameter: ParameterSpec


class DeleteParameter(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Delete a parameter of a container."""

    container: Annotated[str, _NAME]
    name: Annotated[str, AsWritten(written.RosName)]


class Connection(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Two interfaces that are (to be) joined."""

    tag_a: Annotated[str, _PATH]
    tag_b: Annotated[str, _PATH]


class ConfigureComponents(Struct, frozen=True, kw_only=True, omit_defaults=True, tag=True, tag_field="t"):
    """Add and remove nodes, interfaces and parameters. Removals come first."""

    add_nodes: tuple[AddNode, ...] = ()
    remove_nodes: tuple[RemoveNode, ...] = ()
    add_interfaces: tuple[AddInterface, ...] = ()
    remove_interfaces: tuple[RemoveInterface, ...] = ()
    set_param: tuple[SetParameter, ...] = ()
    delete_param: tuple[DeleteParameter, ...] = ()
    faults: tuple[FieldFault, ...] = ()
    """Of the items that were refused in reading."""


class ConfigureConnections(Struct, frozen=True, kw_only=True, omit_defaults=True, tag=True, tag_field="t"):
    """Join and part interfaces."""

    connect: tuple[Connection, ...] = ()
    disconnect: tuple[Connection, ...] = ()
    faults: tuple[FieldFault, ...] = ()
    """Of the items that were refused in reading."""


Component: TypeAlias = AddNode | RemoveNode | AddInterface | RemoveInterface | SetParameter | DeleteParameter
"""A part of a container or a robot."""
Item: TypeAlias = Component | Connection
"""A part of a request that is carried out, or refused, by itself."""
Request: TypeAlias = (
    CreateContainer | ResizeContainer | DestroyContainer | ConfigureComponents | ConfigureConnections
)
"""A request of a user to the master."""


def faults_of(item: Request | Item) -> Iterator[FieldFault]:
    """Return the conflicts between valid fields of a request. Paths name attributes."""
    if isinstance(item, CreateContainer):
        if item.resources.network is Network.GROUP and not item.resources.group:
            problem = "is missing; a container in a network of containers names its group"
            yield FieldFault(("resources", "group"), FaultCode.MISSING, problem)
    elif isinstance(item, ResizeContainer):
        if not item.changes.given():
            names = ", ".join(item.changes.__struct_fields__)
            problem = f"says nothing; give one or more of {names}"
            yield FieldFault(("changes",), FaultCode.MISSING, problem)
    elif isinstance(item, AddInterface):
        spec = item.interface
        if not spec.addr and spec.type.endswith(Form.INTERFACE.value):
            problem = f"is missing; a {spec.type} needs its ROS name"
            yield FieldFault(("interface", "addr"), FaultCode.MISSING, problem)
