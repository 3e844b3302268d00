"""The container's way to its peers.

Links come in on a socket that was made outside, and go out through the manager.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING

from rce.control.model import LinkAddress
from rce.link import LinkHub, LinkLost
from rce_container.environment.messages import Dial

if TYPE_CHECKING:
    from rce.control.model import LinkSpec
    from rce.link.carrier import Carrier

_TIMEOUT_S = 10.0


class Operator:
    """Asks the manager for connections to peers, which a container cannot make by itself.

    Args:
        send: Sends a message to the manager; whether there is one.
    """

    def __init__(self, send: Callable[[Dial], bool]) -> None:
        self._send = send
        self._numbers = count(1)
        self._asked: dict[int, asyncio.Future[socket.socket]] = {}

    async def connect(self, address: LinkAddress) -> socket.socket:
        """Get a connected socket.

        Raises:
            OSError: The peer cannot be reached, or there is no manager now.
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
        """Take the manager's answer: a connected socket or an error."""
        answer = self._asked.get(request)
        if isinstance(result, str):
            if answer is not None and not answer.done():
                answer.set_exception(ConnectionError(result))
        elif answer is None or answer.done():
            result.close()
        else:
            answer.set_result(result)


class ContainerHub(LinkHub):
    """A hub without a network of its own.

    Args:
        machine: As of :class:`~rce.link.LinkHub`.
        operator: Dials; None where the container sees the machine's network and sockets.
    """

    def __init__(self, machine: str, operator: Operator | None) -> None:
        super().__init__(machine)
        self._operator = operator

    async def listen(self, sock: socket.socket) -> None:
        """Accept links on a listening unix socket; it belongs to the hub from now on."""
        sock.setblocking(False)
        self._servers.append(await self.loop.create_unix_server(self._accept, sock=sock, backlog=128))

    async def connect(self, spec: LinkSpec) -> Carrier:
        """Reach the accepting end of a link, as :meth:`rce.link.LinkHub.connect`."""
        if self._operator is None or spec.id in self._accepting:
            return await super().connect(spec)
        sock = await self._operator.connect(spec.address)
        try:
            _, carrier = await self.loop.connect_accepted_socket(self._new_carrier, sock)
        except BaseException as error:
            sock.close()
            if isinstance(error, OSError):
                raise LinkLost(f"the connection was of no use: {error}") from error
            raise
        return await self._introduce(carrier, spec)
