"""Connecting to nodes and masters of a ROS graph, whose host names come from their environment variables."""

from __future__ import annotations

import asyncio
import logging
import socket

from rce.dialing import connect_first, resolve

_log = logging.getLogger(__name__)

SLOW = 3.0
"""Seconds after which a name that is still being looked up is logged."""

MAX_TOLD = 1024
"""How many names are remembered as logged."""

_told: dict[str, None] = {}
"""Names that were logged and have not been resolved since, the oldest first."""


class UnresolvedHostError(OSError):
    """A host name that nodes or masters gave cannot be resolved here.

    Attributes:
        host: The name.
    """

    def __init__(self, host: str, reason: str) -> None:
        super().__init__(f"host name {host!r} cannot be resolved: {reason}")
        self.host = host


async def open_peer_socket(host: str, port: int) -> socket.socket:
    """Connect to a node or master as :func:`rce.dialing.open_socket` does.

    A name that cannot be resolved is logged once until it can be.

    Raises:
        UnresolvedHostError: The name cannot be resolved.
        OSError: No address answers.
    """
    slow = asyncio.get_running_loop().call_later(SLOW, _tell, host, f"no answer within {SLOW:g} s")
    try:
        addresses = await resolve(host, port)
    except (socket.gaierror, UnicodeError) as error:
        reason = error.strerror if isinstance(error, socket.gaierror) else str(error)
        _tell(host, reason or "no reason given")
        raise UnresolvedHostError(host, reason or "no reason given") from error
    finally:
        slow.cancel()
    _told.pop(host, None)
    return await connect_first(addresses)


def _tell(host: str, reason: str) -> None:
    if host in _told:
        return
    if len(_told) >= MAX_TOLD:
        del _told[next(iter(_told))]
    _told[host] = None
    _log.warning(
        "host name %r cannot be resolved: %s. Set ROS_HOSTNAME or ROS_IP, where the nodes of that host are"
        " started, to a name or address that this machine can reach; or add the name to DNS or /etc/hosts",
        host,
        reason,
    )
