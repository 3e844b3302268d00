"""Splits large requests: the engine takes a limited number of items in one message. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.model import ConfigureComponents, ConfigureConnections, Request
from rce.protocol import MAX_ITEMS

if TYPE_CHECKING:
    from collections.abc import Iterator


_COMPONENTS = (
    "remove_nodes",
    "remove_interfaces",
    "delete_param",
    "set_param",
    "add_interfaces",
    "add_nodes",
)
"""In the order in which they are sent: removals first, and nodes when their parameters are there."""
_CONNECTIONS = ("disconnect", "connect")


def parts_of(request: Request, limit: int = MAX_ITEMS) -> Iterator[Request]:
    """Yield requests that together do the same, each with at most ``limit`` items.

    Args:
        request: Any request; one without lists, or with few items, is yielded as it is.
        limit: Items of a part.
    """
    if not isinstance(request, ConfigureComponents | ConfigureConnections):
        yield request
        return
    names = _COMPONENTS if isinstance(request, ConfigureComponents) else _CONNECTIONS
    items = [(name, item) for name in names for item in getattr(request, name)]
    if len(items) <= limit:
        yield request
        return
    for first in range(0, len(items), limit):
        lists: dict[str, list[Any]] = {}
        for name, item in items[first : first + limit]:
            lists.setdefault(name, []).append(item)
        yield type(request)(**{name: tuple(listed) for name, listed in lists.items()})
