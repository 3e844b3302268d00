"""Limits the messages that a manager accepts from an environment, in content, size and rate.

An environment runs beside its container's nodes, so they may control it. Its messages can concern only its
own container, within the sizes of a container, and cost the manager, the master and other users no more than
that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterable, Mapping
from itertools import islice
from typing import TypeVar

import msgspec
from msgspec.structs import asdict, replace

from rce.control import (
    DesiredState,
    EndpointState,
    EndpointStatus,
    InterfaceUsage,
    LinkAddress,
    NodeStatus,
    StatusPatch,
    Unknown,
)
from rce.model import MAX_STATE, is_name
from rce.printable import one_line
from rce_container.environment import messages as m

T = TypeVar("T")

MAX_TEXT = 2000
"""Characters of a text for users."""
MAX_ITEMS = 4096
"""Nodes of one container."""
MAX_INTERFACES = 16384
"""Of one container; more than the master allows users to make."""
MAX_CONNECTIONS = 65536
MAX_DETAILS = 64_000
"""Bytes of the texts of all nodes of a container."""
MAX_UNKNOWN_NODES = 64_000
"""About how many bytes a report may hold of nodes that are not desired: nodes that are removed end first."""
MAX_UNKNOWN = 500_000
"""The same of nodes, and of interfaces and connections, while the desired state is not known."""
_PER_ITEM = 20
_PER_NODE = 100
_MAX_NUMBER = 2**53
"""The largest value of a counter; all JSON readers take numbers up to here."""
_MAX_CODE = 255
_STATES = frozenset({EndpointState.RUNNING, EndpointState.DEGRADED, EndpointState.STOPPING})

BYTES_PER_S = 4_000_000.0
"""The long-term rate of an environment's messages."""
BURST = 40_000_000.0
"""The size of a burst; more than a whole line."""
PER_LINE = 2_000
"""The cost of a line in addition to its bytes."""
PER_FAULT = 200_000
"""The same for a line that is reported to a user and kept."""
PER_PART = 500
"""The same for each interface and connection of a specification that it requests again."""
PER_LOOK = 100_000
"""The same for a line that makes the manager search for processes."""
PER_PROCESS = 500
"""The same for each process of the container in such a search."""

MAX_UNREAD = 64
"""Lines that may wait for an environment to read them; while there are more, its own are not read."""
MAX_DIALS = 256
"""Connections to peers that may be under way for one container."""
PER_STATE = 200_000
"""The cost of a snapshot of a node's state in addition to its bytes, in a count of its own."""


def read(line: bytes) -> m.ToManager | Unknown:
    """Read a message of an environment.

    Raises:
        msgspec.DecodeError: It is not a message.
    """
    try:
        return m.decode_to_manager(line)
    except (RecursionError, UnicodeError) as error:
        raise msgspec.DecodeError(str(error)) from error


def sanitize_text(text: str) -> str:
    """Shorten a text that is too long for users, and remove terminal control characters."""
    text = one_line(text)
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]} ..."


def sanitize_status(id_: str, status: EndpointStatus, newest: int) -> EndpointStatus:
    """Return the plausible parts of a container's report.

    Args:
        id_: The container; replaces the id in the report.
        status: The environment's report.
        newest: The newest revision that it was given.
    """
    nodes = {node.tag: node for node in islice(status.nodes, MAX_ITEMS) if is_name(node.tag)}
    return replace(
        status,
        id=id_,
        revision=min(_whole(status.revision, least=-1), newest),
        state=status.state if status.state in _STATES else EndpointState.RUNNING,
        incarnation="",
        detail="",
        nodes=tuple(map(_sanitize_node, nodes.values())),
        interfaces=_named(status.interfaces),
        connections=tuple(map(_whole, status.connections[:MAX_CONNECTIONS])),
        address=LinkAddress(),
    )


def sanitize_patch(id_: str, patch: StatusPatch, newest: int) -> StatusPatch:
    """Return the plausible parts of a patch of a container's report; as :func:`sanitize_status`."""
    return StatusPatch(
        status=sanitize_status(id_, patch.status, newest),
        removed_interfaces=tuple(filter(is_name, patch.removed_interfaces[:MAX_INTERFACES])),
        lost_connections=tuple(map(_whole, patch.lost_connections[:MAX_CONNECTIONS])),
    )


def sanitize_counters(said: m.Counters) -> m.Counters:
    """Return the plausible counters of a container's links and interfaces."""
    return m.Counters(
        interfaces={
            tag: InterfaceUsage(**{key: _whole(value) for key, value in asdict(one).items()})
            for tag, one in _named(said.interfaces).items()
        },
        traffic=(_whole(said.traffic[0]), _whole(said.traffic[1])),
    )


def state_fault(said: m.StateWanted | m.StateOffered) -> str:
    """Return why a snapshot is not carried; empty if it is."""
    if not is_name(said.node):
        return "it names no node"
    if isinstance(said, m.StateOffered) and not 0 <= said.size <= MAX_STATE:
        return f"it has more than {MAX_STATE} bytes"
    if not 0 <= said.request <= _MAX_NUMBER:
        return "its number is too large"
    return ""


def _sanitize_node(node: NodeStatus) -> NodeStatus:
    code = node.exit_code
    return replace(
        node,
        pid=_whole(node.pid),
        exit_code=None if code is None else max(-_MAX_CODE, min(code, _MAX_CODE)),
        restarts=_whole(node.restarts),
        detail=sanitize_text(node.detail),
    )


def _named(things: Mapping[str, T]) -> dict[str, T]:
    return {tag: thing for tag, thing in islice(things.items(), MAX_INTERFACES) if is_name(tag)}


def _whole(number: int, *, least: int = 0) -> int:
    return max(least, min(number, _MAX_NUMBER))


class PartFilter:
    """Leaves out the parts of one container's reports that are not desired.

    Otherwise a few environments could make what the manager tells a master, in one message, too large for it.
    Before the desired state is known, as after a restart of the manager, little is kept of everything.
    """

    def __init__(self) -> None:
        self._room = MAX_UNKNOWN
        """Bytes left for interfaces and connections while the desired state is not known."""

    def whole(self, status: EndpointStatus, desired: DesiredState | None) -> EndpointStatus:
        """Return what is kept of a sanitized report."""
        self._room = MAX_UNKNOWN
        return self._keep(status, desired)

    def patch(self, patch: StatusPatch, desired: DesiredState | None) -> StatusPatch:
        """Return what is kept of a sanitized patch."""
        return replace(patch, status=self._keep(patch.status, desired))

    def _keep(self, status: EndpointStatus, desired: DesiredState | None) -> EndpointStatus:
        if desired is None:
            return replace(
                status,
                nodes=_keep_nodes(status.nodes, frozenset(), MAX_UNKNOWN),
                interfaces={tag: up for tag, up in status.interfaces.items() if self._has_room(len(tag))},
                connections=tuple(one for one in status.connections if self._has_room(0)),
            )
        nodes = frozenset(node.tag for node in desired.contents.nodes)
        return replace(
            status,
            nodes=_keep_nodes(status.nodes, nodes, MAX_UNKNOWN_NODES),
            interfaces={tag: up for tag, up in status.interfaces.items() if tag in desired.interfaces},
            connections=tuple(one for one in status.connections if one in desired.connections),
        )

    def _has_room(self, length: int) -> bool:
        self._room -= _PER_ITEM + length
        return self._room >= 0


def _keep_nodes(nodes: Iterable[NodeStatus], desired: Container[str], room: int) -> tuple[NodeStatus, ...]:
    kept: list[NodeStatus] = []
    details = MAX_DETAILS
    for node in nodes:
        detail = _cut(node.detail, details)
        details -= len(detail.encode())
        if node.tag not in desired:
            room -= _PER_NODE + len(node.tag) + len(detail.encode())
            if room < 0:
                continue
        kept.append(node if detail == node.detail else replace(node, detail=detail))
    return tuple(kept)


def _cut(text: str, size: int) -> str:
    """Return the beginning of a text, of so many bytes at most."""
    data = text.encode()
    return text if len(data) <= size else data[:size].decode(errors="ignore")


class Pace:
    """Limits the rate at which an environment is read; unread messages stay in its pipe.

    Args:
        clock: Seconds of a monotonic clock.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left = BURST
        self._since = clock()

    def pay(self, cost: float) -> None:
        """Count what was read, in bytes or their equivalent."""
        now = self._clock()
        self._left = min(BURST, self._left + (now - self._since) * BYTES_PER_S) - cost
        self._since = now

    @property
    def pause(self) -> float:
        """Seconds until the next read; 0 within the allowed rate."""
        return max(0.0, -self._left / BYTES_PER_S)
