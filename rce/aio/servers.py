"""End listening without losing a connection that is being accepted."""

from __future__ import annotations

import asyncio
from collections.abc import Collection

_NEXT_TIMERS_S = 1e-9
"""A sleep that ends when the event loop next runs its timers; zero would end it before."""


async def close_servers(servers: Collection[asyncio.Server]) -> None:
    """Close servers between two steps of the event loop in which none of their clients is half accepted.

    Python 3.11 accepts a connection in one step and makes its transport in the next. If the server is closed
    between the two, making the transport fails and the socket stays open without an owner
    (https://github.com/python/cpython/issues/109564, repaired in later versions). The loop accepts before it
    runs its timers, so what follows a timer comes after the transports of all accepted connections were made
    and before the next accept.

    The protocols of connections that were just accepted are told of them after this returns; a server's owner
    must refuse those. Servers are closed also if this is cancelled.

    Args:
        servers: Servers of this event loop.
    """
    try:
        if servers:
            await asyncio.sleep(_NEXT_TIMERS_S)
    finally:
        for server in servers:
            server.close()
