"""WebSocket servers with a lobby."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from websockets.asyncio.server import ServerConnection
from websockets.protocol import State

from rce.guard.lobby import Guest, Lobby, address_of
from rce.guard.plain import PlainPort

if TYPE_CHECKING:
    import asyncio


class GuardedConnection(ServerConnection):
    """A connection that waits in a lobby until it is known; made by what :func:`guarded` returns."""

    lobby: Lobby
    plain: PlainPort
    _guest: Guest | None = None
    _heard = False

    def speak(self) -> None:
        """Take note that its handshake's request has come, so that others do not take its place any more."""
        if self._guest is not None:
            self._guest.speak()

    def become_known(self) -> None:
        """Leave the lobby: the peer has authenticated."""
        if self._guest is not None:
            self._guest.leave()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Enter the lobby, or drop the connection."""
        super().connection_made(transport)
        address = address_of(transport.get_extra_info("peername"))
        self._guest = self.lobby.enter(address, self.transport.abort)
        if self._guest is None:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Drop a client that sends garbage, or closes its side, before the handshake was answered.

        The library has given such a connection up then, and could not send its answer. TLS clients of a plain
        port are told what they are.
        """
        if not self._heard:
            self._heard = True
            if self.plain.refuses(self.transport, data, self.loop.time()):
                self.protocol.state = State.CLOSED
                return
        super().data_received(data)
        if self.protocol.state is State.CONNECTING and self.protocol.eof_sent:
            self._give_up()

    def eof_received(self) -> None:
        """Drop a client that closes its side before the handshake was answered."""
        if self.protocol.state is State.CONNECTING:
            self._give_up()
        else:
            super().eof_received()

    def _give_up(self) -> None:
        self.protocol.state = State.CLOSED
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave."""
        super().connection_lost(exc)
        self.become_known()


ConnectionT = TypeVar("ConnectionT", bound=GuardedConnection)


def guarded(kind: type[ConnectionT], lobby: Lobby) -> type[ConnectionT]:
    """Return the kind of connection with this lobby, for ``serve(create_connection=...)``."""
    return type(
        kind.__name__,
        (kind,),
        {"lobby": lobby, "plain": PlainPort(lobby.name), "__module__": kind.__module__},
    )
