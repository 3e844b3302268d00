"""Requests of clients, as they are spelled in the messages ``CC``, ``RC``, ``DC``, ``CN`` and ``CX``.

Wire source: ``docs/protocol.md``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.model import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    FaultCode,
    FieldFault,
    InterfaceSpec,
    Item,
    NodeSpec,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParameter,
    SpecError,
)
from rce.model.spelling import Spelling, camel, short
from rce.protocol.exceptions import MessageError
from rce.protocol.messages import REQUEST_TYPES

if TYPE_CHECKING:
    from collections.abc import Generator

SPELLING = Spelling(
    camel,
    {
        (CreateContainer, "tag"): "containerTag",
        (ResizeContainer, "tag"): "containerTag",
        (DestroyContainer, "tag"): "containerTag",
        (AddNode, "container"): "containerTag",
        (NodeSpec, "tag"): "nodeTag",
        (NodeSpec, "state_services"): "state",
        (RemoveNode, "container"): "containerTag",
        (RemoveNode, "tag"): "nodeTag",
        (SetParameter, "container"): "containerTag",
        (DeleteParameter, "container"): "containerTag",
        (AddInterface, "endpoint"): "endpointTag",
        (InterfaceSpec, "tag"): "interfaceTag",
        (InterfaceSpec, "type"): "interfaceType",
        (InterfaceSpec, "message_type"): "className",
        (RemoveInterface, "endpoint"): "endpointTag",
        (RemoveInterface, "tag"): "interfaceTag",
    },
    below={CreateContainer: "containerData", ResizeContainer: "containerData"},
)
"""The names of the fields in the client protocol."""

_LISTS: dict[type[Request], dict[str, type[Item]]] = {
    ConfigureComponents: {
        "add_nodes": AddNode,
        "remove_nodes": RemoveNode,
        "add_interfaces": AddInterface,
        "remove_interfaces": RemoveInterface,
        "set_param": SetParameter,
        "delete_param": DeleteParameter,
    },
    ConfigureConnections: {"connect": Connection, "disconnect": Connection},
}
"""The lists of items that a request has, by their attributes."""

MAX_ITEMS = 512
"""Items of all lists of one ``CN`` or ``CX``: each is read on its own."""
STEP_ITEMS = 16
"""Items that are read in one step, in about half a millisecond."""
_MAX_FAULTS = 32
"""Wrong items of one ``CN`` or ``CX`` after which no more are read."""


def is_long(kind: str, data: Any) -> bool:
    """Return whether a request is long enough for :func:`read_in_steps`."""
    lists = _LISTS.get(REQUEST_TYPES[kind])
    return lists is not None and isinstance(data, dict) and _count(data, lists) > STEP_ITEMS


def read_request(kind: str, data: Any) -> Request:
    """Make a request from its type and its ``data``.

    Raises:
        MessageError: ``kind`` is not a request, or ``data`` as a whole is wrong. Wrong items of a ``CN`` or
            ``CX`` do not raise: they are in ``faults``.
    """
    reading = read_in_steps(kind, data)
    while True:
        try:
            next(reading)
        except StopIteration as end:
            request: Request = end.value
            return request


def read_in_steps(kind: str, data: Any) -> Generator[None, None, Request]:
    """Make a request as :func:`read_request` does; stop after each few items.

    Returns:
        The request.

    Raises:
        MessageError: ``kind`` is not a request, or ``data`` as a whole is wrong. Wrong items of a ``CN`` or
            ``CX`` do not raise: they are in ``faults``.
    """
    cls = REQUEST_TYPES.get(kind)
    if cls is None:
        raise MessageError("type", f"{short(kind)} is not a request; use one of {', '.join(REQUEST_TYPES)}")
    if not isinstance(data, dict):
        raise MessageError("data", f"must be an object, not {kind_of(data)}")
    if cls in _LISTS:
        return cls(**(yield from _read_lists(data, _LISTS[cls])))
    try:
        return SPELLING.read(cls, data, ("data",))
    except SpecError as error:
        raise MessageError.of(error.faults) from error


def write_request(request: Request) -> dict[str, Any]:
    """Write the ``data`` of a request."""
    lists = _LISTS.get(type(request))
    if lists is None:
        return SPELLING.write(request)
    written = {camel(name): [SPELLING.write(item) for item in getattr(request, name)] for name in lists}
    return {key: items for key, items in written.items() if items}


def kind_of(value: Any) -> str:
    """Return the kind of a JSON value."""
    names = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else "binary")


def _count(data: dict[str, Any], lists: dict[str, type[Item]]) -> int:
    return sum(len(items) for name in lists if isinstance(items := data.get(camel(name)), list))


def _read_lists(data: dict[str, Any], lists: dict[str, type[Item]]) -> Generator[None, None, dict[str, Any]]:
    """Read each item of each list on its own, so that a wrong one does not affect the others."""
    count = _count(data, lists)
    if count > MAX_ITEMS:
        raise MessageError(
            "data",
            f"{count} items are over the limit of {MAX_ITEMS}; send them in several messages",
            FaultCode.LIMIT,
        )
    read: dict[str, Any] = {}
    faults: list[FieldFault] = []
    for name, cls in lists.items():
        place = ("data", camel(name))
        items = data.get(camel(name))
        if items is None:
            continue
        if not isinstance(items, list):
            problem = f"must be a list, not {kind_of(items)}"
            faults.append(FieldFault(place, FaultCode.INVALID, problem))
            continue
        good = []
        for index, item in enumerate(items):
            if len(faults) >= _MAX_FAULTS:
                problem = f"the last {len(items) - index} items were not read, too many are wrong"
                faults.append(FieldFault(place, FaultCode.LIMIT, problem))
                break
            if index % STEP_ITEMS == STEP_ITEMS - 1:
                yield
            try:
                good.append(SPELLING.read(cls, item, (*place, index)))
            except SpecError as error:
                faults += error.faults
        read[name] = tuple(good)
    read["faults"] = tuple(faults)
    return read
