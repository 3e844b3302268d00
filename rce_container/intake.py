"""What a manager takes from an environment: no more than a sound one would say, and no faster.

An environment runs beside its container's nodes, so it may be in their hands. Whatever it says is of its own
container, has the sizes of a container, and costs the manager, the master and other users no more than that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import islice
from typing import TypeVar

import msgspec
from msgspec.structs import asdict, replace

from rce.control.model import (
    EndpointState,
    EndpointStatus,
    InterfaceUsage,
    LinkAddress,
    NodeStatus,
    StatusPatch,
)
from rce.control.tags import Unknown
from rce.model.names import is_name
from rce.protocol.printable import one_line
from rce_container.environment import messages as m

T = TypeVar("T")

MAX_TEXT = 2000
"""Characters of a text for people."""
MAX_ITEMS = 4096
"""Nodes of one container."""
MAX_INTERFACES = 16384
"""Of one container; more than the master lets users make."""
MAX_CONNECTIONS = 65536
_MAX_NUMBER = 2**53
"""Whatever is counted; JSON readers everywhere take numbers up to here."""
_MAX_CODE = 255
_STATES = frozenset({EndpointState.RUNNING, EndpointState.DEGRADED, EndpointState.STOPPING})

BYTES_PER_S = 4_000_000.0
"""What an environment may say in the long run."""
BURST = 40_000_000.0
"""What it may say at once; a whole line and more."""
PER_LINE = 2_000
"""What a line costs beside its bytes."""
PER_FAULT = 200_000
"""The same for one that somebody is told of and that is kept."""
PER_PART = 500
"""The same for each interface and connection of a specification that it wants again."""
PER_LOOK = 100_000
"""The same for one that makes the manager look for processes."""


def read(line: bytes) -> m.ToManager | Unknown:
    """Read a message of an environment.

    Raises:
        msgspec.DecodeError: It is none.
    """
    try:
        return m.decode_to_manager(line)
    except (RecursionError, UnicodeError) as error:
        raise msgspec.DecodeError(str(error)) from error


def sanitize_text(text: str) -> str:
    """Cut a text that is too long for people, and take out what their terminals would obey."""
    text = one_line(text)
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]} ..."


def sanitize_status(id_: str, status: EndpointStatus, newest: int) -> EndpointStatus:
    """Take of a report what can be true of a container.

    Args:
        id_: The container, whatever it calls itself.
        status: What its environment says.
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
    """Take of what changed in a report what can be true of a container; as :func:`sanitize_status`."""
    return StatusPatch(
        status=sanitize_status(id_, patch.status, newest),
        removed_interfaces=tuple(filter(is_name, patch.removed_interfaces[:MAX_INTERFACES])),
        lost_connections=tuple(map(_whole, patch.lost_connections[:MAX_CONNECTIONS])),
    )


def sanitize_counters(said: m.Counters) -> m.Counters:
    """Take of counters what can be true of a container's links and interfaces."""
    return m.Counters(
        interfaces={
            tag: InterfaceUsage(**{key: _whole(value) for key, value in asdict(one).items()})
            for tag, one in _named(said.interfaces).items()
        },
        traffic=(_whole(said.traffic[0]), _whole(said.traffic[1])),
    )


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


class Pace:
    """Says how long an environment has to wait until more of it is heard; meanwhile it writes into its pipe.

    Args:
        clock: Seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left = BURST
        self._since = clock()

    def pay(self, cost: float) -> None:
        """Note what was heard, in bytes or their like."""
        now = self._clock()
        self._left = min(BURST, self._left + (now - self._since) * BYTES_PER_S) - cost
        self._since = now

    @property
    def pause(self) -> float:
        """Seconds; 0 as long as it has said no more than it may."""
        return max(0.0, -self._left / BYTES_PER_S)
