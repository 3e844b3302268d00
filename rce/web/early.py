"""Connections of a server that has not loaded its application."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

from rce.web.entry import EntryAnswer, OtherRequestError, read_entry_request, write_entry_answer

if TYPE_CHECKING:
    from collections.abc import Callable


class EarlyConnection(asyncio.Protocol):
    """A connection's protocol while the application is not loaded: answers requests for the entry.

    Args:
        entry: Answers from the query of a request.
        want_application: Called with this connection, which waits for the application from then on.
        others: The connections of this kind, this one among them until it ends or has the application.
        idle_timeout: Seconds without a whole request after which it is closed.

    Attributes:
        waits: Whether it waits for the application.
    """

    def __init__(
        self,
        entry: Callable[[str], EntryAnswer],
        want_application: Callable[[EarlyConnection], None],
        others: set[EarlyConnection],
        idle_timeout: float,
    ) -> None:
        self.waits = False
        self._entry = entry
        self._want_application = want_application
        self._others = others
        self._idle_timeout = idle_timeout
        self._data = b""
        self._transport: asyncio.Transport | None = None
        self._end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for a request."""
        self._transport = cast("asyncio.Transport", transport)
        self._others.add(self)
        self._rest()

    def close(self) -> None:
        """Close the connection."""
        self._leave()
        if self._transport is not None:
            self._transport.close()

    def pass_on(self, protocol: asyncio.Protocol) -> None:
        """Let the application's protocol continue with what has come."""
        self._leave()
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        transport.set_protocol(protocol)
        protocol.connection_made(transport)
        protocol.data_received(self._data)
        transport.resume_reading()

    def data_received(self, data: bytes) -> None:
        """Answer a request, or ask for the application."""
        assert self._transport is not None
        self._data += data
        if self.waits:
            return
        try:
            request = read_entry_request(self._data)
        except OtherRequestError:
            self.waits = True
            self._stay()
            self._transport.pause_reading()
            self._want_application(self)
            return
        if request is None:
            return
        self._data = b""
        self._transport.write(write_entry_answer(self._entry(request.query), closes=request.closes))
        if request.closes:
            self.close()
        else:
            self._rest()

    def pause_writing(self) -> None:
        """Read nothing while the client does not read."""
        assert self._transport is not None
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """Read again."""
        assert self._transport is not None
        if not self.waits:
            self._transport.resume_reading()

    def connection_lost(self, _: Exception | None) -> None:
        """Forget the connection."""
        self._leave()

    def _rest(self) -> None:
        """Wait for a whole request, for the allowed time."""
        self._stay()
        self._end = asyncio.get_running_loop().call_later(self._idle_timeout, self.close)

    def _stay(self) -> None:
        if self._end is not None:
            self._end.cancel()

    def _leave(self) -> None:
        self._stay()
        self._others.discard(self)
