"""The port on which a program accepts links."""

from __future__ import annotations

import errno
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

DEFAULT_PORT = 10030
_log = logging.getLogger(__name__)


async def listen_on(listen: Callable[[str, int], Awaitable[int]], host: str, port: int | None) -> int:
    """Accept links on the given port, else on :data:`DEFAULT_PORT`, or on a free one if that is taken.

    Peers learn the port from the master.

    Args:
        listen: Binds an address and a port (0: a free one); returns the port taken.
        host: Address to bind.
        port: None for the default one.

    Returns:
        The port taken.

    Raises:
        OSError: The port cannot be bound.
    """
    if port is not None:
        return await listen(host, port)
    try:
        return await listen(host, DEFAULT_PORT)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
    _log.info("port %d is taken; links are accepted on another one", DEFAULT_PORT)
    return await listen(host, 0)
