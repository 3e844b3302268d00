"""The container's way to its peers.

A container has no network: the manager connects for it and passes the socket in.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from itertools import count

from rce.control import LinkAddress
from rce_container.environment.messages import Dial

_TIMEOUT_S = 10.0


class DialProxy:
    """Asks the manager for connections to peers, which a container cannot make by itself.

    Args:
        send: Sends a message to the manager; returns whether one is connected.
    """

    def __init__(self, send: Callable[[Dial], bool]) -> None:
        self._send = send
        self._numbers = count(1)
        self._asked: dict[int, asyncio.Future[socket.socket]] = {}

    async def connect(self, address: LinkAddress) -> socket.socket:
        """Get a connected socket.

        Raises:
            OSError: The peer cannot be reached, or no manager is connected.
        """
        number = next(self._numbers)
        answer: asyncio.Future[socket.socket] = asyncio.get_running_loop().create_future()
        self._asked[number] = answer
        try:
            if not self._send(Dial(request=number, address=address)):
                raise ConnectionError("there is no container manager to dial for this container")
            async with asyncio.timeout(_TIMEOUT_S):
                return await answer
        finally:
            del self._asked[number]

    def answered(self, request: int, result: socket.socket | str) -> None:
        """Handle the manager's answer: a connected socket or an error."""
        answer = self._asked.get(request)
        if isinstance(result, str):
            if answer is not None and not answer.done():
                answer.set_exception(ConnectionError(result))
        elif answer is None or answer.done():
            result.close()
        else:
            answer.set_result(result)
