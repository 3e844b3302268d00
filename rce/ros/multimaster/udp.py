"""The sockets of heartbeats.

Two sockets on one port: one bound to the group, which hears what is sent to all, and one bound to the
machine's address, which sends everything and hears what is sent to this machine alone. Other discoveries
of the machine use the same port; of them, only one hears what is sent to the machine, so answers go to the
group too.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import struct
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Self

_log = logging.getLogger(__name__)

TTL = 20
"""How many routers a heartbeat may pass, as fkie's."""

Receive = Callable[[bytes, tuple[str, int], bool], None]
"""Takes a datagram, its sender's address, and whether it was sent to the group."""


class HeartbeatSocket:
    """Sends and receives heartbeats. An async context manager."""

    def __init__(
        self,
        receive: Receive,
        *,
        group: str,
        port: int,
        address: str,
        send_mcast: bool = True,
        listen_mcast: bool = True,
    ) -> None:
        """Prepare the sockets.

        Args:
            receive: Takes what arrives.
            group: IPv4 multicast group.
            port: Port of the group and of this machine.
            address: This machine's address on the interface to use.
            send_mcast: Send to the group.
            listen_mcast: Hear the group.
        """
        self.group = group
        self.port = port
        self.address = address
        self.send_mcast = send_mcast
        self._listen = listen_mcast
        self._receive = receive
        self._own: asyncio.DatagramTransport | None = None
        self._shared: asyncio.DatagramTransport | None = None
        self._complained: set[str] = set()

    async def __aenter__(self) -> Self:
        self._own = await self._open(self._own_socket(), to_group=False)
        if self._listen:
            try:
                self._shared = await self._open(self._shared_socket(), to_group=True)
            except BaseException:
                self._own.close()
                raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for transport in (self._own, self._shared):
            if transport is not None:
                transport.close()
        self._own = self._shared = None
        await asyncio.sleep(0)  # the transports close their sockets in the next turn of the loop

    def send(self, datagram: bytes, hosts: Iterable[tuple[str, int]] = ()) -> None:
        """Send to the group, if that is used, and to ``hosts``."""
        if self.send_mcast:
            self.send_to(datagram, (self.group, self.port))
        for host in hosts:
            self.send_to(datagram, host)

    def send_to(self, datagram: bytes, address: tuple[str, int]) -> None:
        """Send to one address. A datagram that cannot be sent is lost; the reason is logged once."""
        if self._own is None:
            return
        try:
            self._own.sendto(datagram, address)
        except OSError as error:
            self._complain(address[0], error)
        else:
            self._complained.discard(address[0])

    def renew(self) -> None:
        """Join the group again if the interface lost its membership, for example because it was replugged."""
        if self._shared is None or self._own is None:
            return
        for transport, work in ((self._shared, self._join), (self._own, self._choose_interface)):
            try:
                work(transport.get_extra_info("socket"))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:  # the error for: already a member
                    self._complain(self.group, error)

    # Inside

    async def _open(self, sock: socket.socket, *, to_group: bool) -> asyncio.DatagramTransport:
        try:
            transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: _Protocol(self._receive, self._complain, to_group=to_group), sock=sock
            )
        except BaseException:
            sock.close()
            raise
        return transport

    def _own_socket(self) -> socket.socket:
        sock = _shareable_socket()
        try:
            self._choose_interface(sock)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, TTL)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            sock.bind((self.address, self.port))
        except BaseException:
            sock.close()
            raise
        return sock

    def _shared_socket(self) -> socket.socket:
        sock = _shareable_socket()
        try:
            sock.bind((self.group, self.port))
            self._join(sock)
        except BaseException:
            sock.close()
            raise
        return sock

    def _choose_interface(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self.address))

    def _join(self, sock: socket.socket) -> None:
        membership = struct.pack("4s4s", socket.inet_aton(self.group), socket.inet_aton(self.address))
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)

    def _complain(self, host: str, error: OSError) -> None:
        if host not in self._complained:
            self._complained.add(host)
            _log.warning("no heartbeats to %s: %s", host, error.strerror or error)


class _Protocol(asyncio.DatagramProtocol):
    def __init__(self, receive: Receive, complain: Callable[[str, OSError], None], *, to_group: bool) -> None:
        self._receive = receive
        self._complain = complain
        self._to_group = to_group

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._receive(data, addr, self._to_group)

    def error_received(self, exc: Exception) -> None:
        if isinstance(exc, OSError) and exc.errno != errno.ECONNREFUSED:  # no process listens there (yet)
            self._complain("some hosts", exc)


def _shareable_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    return sock
