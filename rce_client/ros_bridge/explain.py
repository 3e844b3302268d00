"""Shows a robot's file in its long form, and its wiring as text or for Graphviz. Pure."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

from rce.config.documents import write_items
from rce.model import InterfaceSpec, Role

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce.config.client import ClientConfig

_FORWARD = (Role.SUBSCRIBER, Role.SERVICE_PROVIDER)
"""Roles at the end where a message, or a service's request, comes from."""


class Wire(NamedTuple):
    """A connection, from where messages or requests come to where they go."""

    source: str
    """Endpoint; other robots' files may have made it."""
    source_name: str
    target: str
    target_name: str
    message_type: str
    is_service: bool


def wires(config: ClientConfig) -> Iterator[Wire]:
    """Return the connections of a file; an interface that it does not list itself has its tag for a name."""
    interfaces = {one.path: one.interface for one in config.interfaces}
    for link in config.connections:
        a, b = interfaces.get(link.tag_a), interfaces.get(link.tag_b)
        known = a or b
        forward = a.kind.role in _FORWARD if a else b is None or b.kind.role not in _FORWARD
        source, target = (link.tag_a, link.tag_b) if forward else (link.tag_b, link.tag_a)
        yield Wire(
            *_end(source, interfaces),
            *_end(target, interfaces),
            known.message_type if known else "?",
            known is not None and known.kind.role.is_service,
        )


def _end(path: str, interfaces: dict[str, InterfaceSpec]) -> tuple[str, str]:
    endpoint, _, tag = path.partition("/")
    found = interfaces.get(path)
    return endpoint, (found.addr or tag) if found else tag


def long_form(config: ClientConfig) -> str:
    """Return the file without bridges, as JSON; credentials are left out."""
    data: dict[str, Any] = config.model_dump(
        by_alias=True, exclude_defaults=True, exclude={"bridges", "password", "token"}
    )
    return write_items(data)


def picture(config: ClientConfig) -> str:
    """Return the wiring as text: endpoints, and below each what leaves it."""
    found = list(wires(config))
    width = max((len(wire.source_name) for wire in found), default=0)
    lines = []
    for source in dict.fromkeys(wire.source for wire in found):
        lines.append(f"{source}{' (robot)' if source == config.robot else ''}")
        for wire in found:
            if wire.source == source:
                arrow = "<->" if wire.is_service else "-->"
                target = f"{wire.target} {wire.target_name}"
                lines.append(f"  {wire.source_name:<{width}}  {arrow}  {target}  [{wire.message_type}]")
    return "\n".join(lines)


def dot(config: ClientConfig) -> str:
    """Return the wiring for Graphviz: ``rce-ros FILE --explain --dot | dot -Tsvg``."""
    found = list(wires(config))
    endpoints = dict.fromkeys((config.robot, *(one.tag for one in config.containers)))
    endpoints |= dict.fromkeys(name for wire in found for name in (wire.source, wire.target))
    lines = ["digraph wiring {", "  rankdir=LR;", "  node [shape=box];"]
    for name in endpoints:
        shape = " [shape=ellipse]" if name == config.robot else ""
        lines.append(f"  {json.dumps(name)}{shape};")
    for wire in found:
        both = ", dir=both" if wire.is_service else ""
        same = wire.source_name == wire.target_name
        names = wire.source_name if same else f"{wire.source_name} to {wire.target_name}"
        label = json.dumps(f"{names}\n{wire.message_type}")
        lines.append(f"  {json.dumps(wire.source)} -> {json.dumps(wire.target)} [label={label}{both}];")
    return "\n".join([*lines, "}"])
