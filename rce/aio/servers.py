"""Begin to listen without leaving a socket open; end without losing a connection that is being accepted."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection

_NEXT_TIMERS_S = 1e-9
"""A sleep that ends when the event loop next runs its timers; zero would end it before."""


async def open_server(
    accept: Callable[[], asyncio.BaseProtocol], host: str | None, port: int, *, backlog: int
) -> asyncio.Server:
    """Accept TCP connections of the running event loop.

    Two programs can bind one port at the same moment; the second is refused only when it begins to listen.
    ``loop.create_server`` leaves its socket open then.

    Args:
        accept: Makes the protocol of a connection.
        host: Address to bind; None is every address.
        port: Zero takes a free one.
        backlog: Connections that the system keeps until they are accepted.

    Raises:
        OSError: The port cannot be bound.
    """
    loop = asyncio.get_running_loop()
    server = await loop.create_server(
        accept, host, port, backlog=backlog, reuse_address=True, start_serving=False
    )
    try:
        await server.start_serving()
    except BaseException:
        server.close()
        raise
    return server


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
