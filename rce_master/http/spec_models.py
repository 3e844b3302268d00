"""The REST API's models of containers, nodes, parameters, interfaces and connections.

Most fields are those of :mod:`rce.model.specs` and :mod:`rce.model.requests`; this module has those of the
API only.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Struct, to_builtins
from pydantic import Field as Option
from pydantic import create_model

from rce.model import (
    AddInterface,
    AddNode,
    Connection,
    CreateContainer,
    DestroyContainer,
    InterfaceSpec,
    NodeSpec,
    ResizeContainer,
    Resources,
    SetParameter,
)
from rce.model.spelling import Field, Spelling, fields_of
from rce.model.written import Value
from rce_master.http.model import Body, Model, Page

if TYPE_CHECKING:
    from collections.abc import Callable

M = TypeVar("M", bound=Model)
Amount = int | float | str
"""An amount as :mod:`rce.model.quantities` reads it."""

SPELLING = Spelling(
    str,
    {
        (ResizeContainer, "tag"): "container",
        (DestroyContainer, "tag"): "container",
        (InterfaceSpec, "message_type"): "cls",
    },
)
"""The REST API's names of the fields."""


def takes(request: type[Struct], *path: str) -> Callable[[type[M]], type[M]]:
    """Give a body the fields of a request.

    Args:
        request: The request.
        path: Those of its fields that are in the URL's path.
    """

    def extend(model: type[M]) -> type[M]:
        fields = [field for field in fields_of(request) if SPELLING.key(field) not in path]
        return _extended(model, {SPELLING.key(field): (_taken(field), _default(field)) for field in fields})

    return extend


def gives(spec: type[Struct]) -> Callable[[type[M]], type[M]]:
    """Give an answer the fields of a spec, as :func:`shown` shows them."""

    def extend(model: type[M]) -> type[M]:
        return _extended(model, {SPELLING.key(field): (_given(field), ...) for field in fields_of(spec)})

    return extend


def shown(spec: Struct) -> dict[str, Any]:
    """Show the fields of a spec: amounts as numbers, in bytes and cores."""
    return {SPELLING.key(field): _plain(field.get(spec)) for field in fields_of(type(spec))}


def _extended(model: type[M], fields: dict[str, Any]) -> type[M]:
    return create_model(
        model.__name__, __base__=model, __module__=model.__module__, __doc__=model.__doc__, **fields
    )


def _taken(field: Field) -> Any:
    """Return the type of a sent field; the request's reader validates the value."""
    kind = field.rule.type
    if get_origin(kind) is Literal:
        kind = str
    elif get_origin(field.kept) is tuple:
        kind = list[_item(kind) or str]  # type: ignore[misc]  # made at run time
    elif _is_spec(kind):
        kind = _model(kind)
    elif field.rule.type != Value and len(get_args(kind)) > 1 and get_origin(kind) is not None:
        kind = get_args(kind)[0] if hasattr(kind, "__metadata__") else Amount
    return kind | None if field.default is None else kind


def _default(field: Field) -> Any:
    if field.required:
        return ...
    if field.default is None:
        return None
    return Option(default=field.rule.write(field.default) if field.rule.blank is None else field.rule.blank)


def _given(field: Field) -> Any:
    """Return the type of a shown field."""
    if isinstance(field.kept, type) and issubclass(field.kept, Enum):
        return str
    if get_origin(field.kept) is tuple:
        return list[_item(field.kept) or str]  # type: ignore[misc]  # made at run time
    spec = next(filter(_is_spec, get_args(field.kept)), None)
    return field.kept if spec is None else _model(spec) | None


def _is_spec(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Struct)


def _item(kind: Any) -> Any:
    """Return the model of the specs in a list, such as volumes; None for a list of texts."""
    spec = next(iter(get_args(kind)), None)
    return _model(spec) if _is_spec(spec) else None


def _model(spec: Any) -> Any:
    """Return the model of a spec in another one."""
    hints = get_type_hints(spec)
    types: dict[str, Any] = {}
    for one in msgspec.structs.fields(spec):
        kind = Amount if len(get_args(hints[one.name])) > 1 else hints[one.name]
        types[one.name] = (kind, ... if one.required else one.default)
    return create_model(spec.__name__, __base__=Body, __doc__=spec.__doc__, **types)


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.value
    return to_builtins(value) if isinstance(value, tuple | Struct) else value


# In


@takes(CreateContainer)
class ContainerIn(Body):
    """A container to create. Zero and empty values are not requested."""


@takes(ResizeContainer, "container")
class ResizeIn(Body):
    """New resources of a container. Null or left out: unchanged; zero: not requested any more."""


@takes(AddNode, "container")
class NodeIn(Body):
    """A node to start."""


@takes(SetParameter, "container")
class ParameterIn(Body):
    """A parameter to set."""


@takes(AddInterface, "endpoint")
class InterfaceIn(Body):
    """An interface to create."""


@takes(Connection)
class ConnectionIn(Body):
    """Two interfaces to connect, each ``ENDPOINT/INTERFACE``."""


# Out


@gives(Resources)
class RequestedOut(Model):
    """The resources that a container requested; zero or empty: not requested."""


class ContainerOut(Model):
    """A container."""

    id: str
    user: str
    tag: str
    state: str
    """``requested``, ``placed``, ``starting``, ``running``, ``degraded``, ``failed``, ``stopping``,
    ``stopped`` or ``lost``."""
    detail: str
    task_set: str
    machine: str
    revision: int
    incarnation: str
    nodes: int
    interfaces: int
    cpu_s: float
    """CPU seconds since its start."""
    memory: int
    """Bytes in use."""
    requested: RequestedOut = Option(alias="wish")
    moving_to: str
    """While its machine is drained: the task set that starts its copy; else empty."""


@gives(NodeSpec)
class NodeOut(Model):
    """A node."""

    user: str
    container: str
    state: str
    """``waiting``, ``starting``, ``running``, ``stuck``, ``stopping``, ``exited``, ``failed``; ``unknown``
    until reported."""
    pid: int
    exit_code: int | None
    detail: str
    restarts: int
    """Number of automatic restarts."""


class ParameterOut(Model):
    """A parameter."""

    user: str
    container: str
    name: str
    value: Value


@gives(InterfaceSpec)
class InterfaceOut(Model):
    """An interface."""

    user: str
    endpoint: str
    active: bool
    """Whether it has an established connection."""
    messages_in: int
    messages_out: int
    bytes_in: int
    bytes_out: int
    dropped: int


class ConnectionOut(Model):
    """A connection."""

    id: int
    user: str
    tag_a: str
    tag_b: str
    established: bool
    """Whether both ends report it as open."""


class ContainersOut(Page):
    """Containers."""

    containers: list[ContainerOut]


class NodesOut(Page):
    """Nodes."""

    nodes: list[NodeOut]


class ParametersOut(Page):
    """Parameters."""

    parameters: list[ParameterOut]


class InterfacesOut(Page):
    """Interfaces."""

    interfaces: list[InterfaceOut]


class ConnectionsOut(Page):
    """Connections."""

    connections: list[ConnectionOut]
