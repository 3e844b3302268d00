"""A container's links on its machine: accepted links, and the peers that it may dial."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING

from rce.dialing import open_socket
from rce.link import HandoverSender, LinkAcceptor

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce.control import EndpointSpec, LinkAddress, LinkSpec, SpecPatch
    from rce_container.settings import ContainerSettings

_DIAL_TIMEOUT_S = 5.0


class ContainerLinks:
    """The machine's side of the links of one incarnation of a container.

    Args:
        acceptor: Accepts links by TCP for all containers of the machine.
        settings: How containers are run.
    """

    def __init__(self, acceptor: LinkAcceptor, settings: ContainerSettings) -> None:
        self._acceptor = acceptor
        self._settings = settings
        self._sender: HandoverSender | None = None

    def open(self) -> socket.socket:
        """Begin to hand accepted links over; return the environment's end, which the caller closes."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sender = HandoverSender(ours)
        return theirs

    def close(self) -> None:
        """Stop handing links over."""
        sender, self._sender = self._sender, None
        if sender is not None:
            self._acceptor.forget(sender)
            sender.close()

    async def assign(self, spec: EndpointSpec) -> None:
        """Accept exactly the links of a specification."""
        if self._sender is not None:
            await self._acceptor.assign(self._sender, [link.id for link in spec.links if not link.dial])

    async def change(self, patch: SpecPatch) -> None:
        """Apply a patch to the links."""
        if self._sender is not None:
            accepted = [link.id for link in patch.links if not link.dial]
            dialed = [link.id for link in patch.links if link.dial]
            await self._acceptor.reassign(self._sender, accepted, [*patch.removed_links, *dialed])

    async def dial(self, address: LinkAddress, links: Iterable[LinkSpec]) -> socket.socket:
        """Connect to a peer of the container; refuse other addresses.

        Args:
            address: Of the peer.
            links: The container's links.

        Raises:
            OSError: The container has no link to this address, or the peer does not answer.
        """
        if not any(address in (link.address, link.next) for link in links):
            raise ConnectionError("the container has no link to there")
        async with asyncio.timeout(_DIAL_TIMEOUT_S):
            return await dial(address, self._settings.machine, tls=self._settings.tls)


async def dial(address: LinkAddress, machine: str, *, tls: bool = False) -> socket.socket:
    """Connect by the unix socket if it is on this machine, else by TCP.

    Args:
        address: Of the peer.
        machine: Name of this machine.
        tls: Refuse peers that take links by TCP without TLS.

    Raises:
        OSError: The peer does not answer, or only without TLS.
    """
    if address.unix and address.machine == machine:
        try:
            return await _connect_unix(address.unix)
        except OSError:
            if not address.port:
                raise
    if not address.port:
        raise ConnectionError("the peer has no address that can be reached from here")
    if tls and not address.tls:
        raise ConnectionError("the peer takes links without TLS only; start its program with --tls")
    return await open_socket(address.host, address.port)


async def _connect_unix(path: str) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, path)
    except BaseException:
        sock.close()
        raise
    return sock
