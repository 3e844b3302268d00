"""Keeps two programs from doing the same for one fleet: the second stands by until the first has ended.

Each planner provides one service, each fleet manager another. A program that was hung, or was started at the
same moment as another one, finds that the other has taken over its service: it stops, and stands by.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rce.ros.errors import MasterError
from rce.ros.node.master import MasterClient
from rce.ros.tcpros.header import encode_header
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.ros.node import Node
    from rce_fleet.nodes.graph_look import GraphState

_LOOK_EVERY = 1.0
"""Seconds between two looks for another program."""
_PROBE_S = 2.0
"""Seconds in which a running program answers."""
HUNG_S = 30.0
"""Seconds after which a program that accepts connections and does not answer is given up."""


@dataclass(frozen=True, slots=True)
class Turn:
    """The end of standing by.

    Attributes:
        is_due: Whether to go on; False if the node was stopped meanwhile.
        predecessor: Node and address of the program that was registered last; it may be hung; empty: none.
    """

    is_due: bool
    predecessor: str = ""


class _Presence(Enum):
    """What is at the address of a service."""

    GONE = auto()
    """Nothing that accepts connections."""
    HUNG = auto()
    """The kernel accepts connections; the program does not answer."""
    ANSWERS = auto()
    """A program that answers, or closes the connection."""


async def serve_in_turn(serve: Callable[[], Awaitable[int | None]]) -> int:
    """Run a program until it ends; return its exit code.

    Args:
        serve: Runs it once, with a node of its own; returns the exit code, or None if another program has
            taken over, so that this one is to stand by.
    """
    code = None
    while code is None:
        code = await serve()
    return code


async def stand_by(node: Node, program: str, service: str, then: str = "takes over") -> Turn:
    """Wait while another program of its kind serves this ROS graph.

    The registration of a program that was killed stays at the master; so the service's address is tried too.
    A program that has been stopped still accepts connections: after :data:`HUNG_S` without an answer this one
    takes over, and the other one stands by when it runs again.

    Args:
        node: Running node, before it provides services.
        program: What it is, for people: ``planner``.
        service: The service that every program of its kind provides.
        then: What this one does after it has waited, for people.
    """
    predecessor, is_told, hung_since = "", False, 0.0
    async with RpcClient() as rpc:
        master = MasterClient(node.master_uri, node.name, node.uri, rpc)
        while True:
            address = await _service_address(master, service)
            presence = await _look(address, service, node.name)
            if address and not predecessor.endswith(address):
                predecessor = await _provider(master, service, address)
            if presence is _Presence.GONE:
                break
            if presence is _Presence.ANSWERS:
                hung_since = 0.0
            elif not hung_since:
                hung_since = time.monotonic()
                node.log.error(
                    "the other %s (%s at %s) accepts connections and does not answer: this one %s"
                    " in %.0f s if that stays so",
                    *(program, service, address, then, HUNG_S),
                )
            elif time.monotonic() - hung_since >= HUNG_S:
                node.log.warning(
                    "the other %s has not answered for %.0f s: this one %s; end the other one, %s",
                    *(program, HUNG_S, then, predecessor),
                )
                break
            if not is_told:
                node.log.error(
                    "another %s serves this fleet (%s at %s): this one stands by until it ends",
                    program,
                    service,
                    address,
                )
                is_told = True
            if not await node.sleep(_LOOK_EVERY):
                return Turn(is_due=False)
    if is_told and presence is _Presence.GONE:
        node.log.warning("the other %s has ended: this one %s", program, then)
    return Turn(not node.is_shutdown, predecessor)


def successor(node: Node, graph: GraphState, service: str) -> str:
    """Return the node that has taken over the service of a running one; empty: none has.

    Args:
        node: The node that has provided the service since it went on.
        graph: The ROS graph as it is now.
        service: The service.
    """
    providers = graph.services.get(service, [])
    return "" if not providers or node.name in providers else providers[0]


async def _service_address(master: MasterClient, service: str) -> str:
    """Return the address of the service's provider; empty without one."""
    try:
        return str(await master.call("lookupService", service))
    except MasterError:
        return ""


async def _provider(master: MasterClient, service: str, address: str) -> str:
    """Return the node that provides a service, and the service's address."""
    try:
        _, _, services = await master.call("getSystemState")
        names = [str(node) for name, nodes in services if name == service for node in nodes]
    except (MasterError, TypeError, ValueError):
        names = []
    return " at ".join((*names[:1], address))


async def _look(address: str, service: str, caller: str) -> _Presence:
    """Return what is at an address such as ``rosrpc://host:port``; only the service's type is asked for."""
    place = urlsplit(address)
    if place.hostname is None or place.port is None:
        return _Presence.GONE
    try:
        async with asyncio.timeout(_PROBE_S):
            reader, writer = await asyncio.open_connection(place.hostname, place.port)
    except (OSError, TimeoutError):
        return _Presence.GONE
    try:
        writer.write(encode_header({"callerid": caller, "service": service, "md5sum": "*", "probe": "1"}))
        async with asyncio.timeout(_PROBE_S):
            await reader.read(1)
    except TimeoutError:
        return _Presence.HUNG
    except OSError:
        pass  # It ended meanwhile, or refuses: the next look tells.
    finally:
        writer.close()
    return _Presence.ANSWERS
