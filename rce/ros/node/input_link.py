"""One connection of a subscriber to a publisher, from the publisher's header on."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce.ros.errors import TcprosError
from rce.ros.tcpros.header import ANY, check_type, decode_header, raise_error_field

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.errors import HandshakeRefusedError
    from rce.ros.node.topic_input import TopicInput
    from rce.ros.tcpros.connection import Connection

_log = logging.getLogger(__name__)


def says_latching(fields: Mapping[str, str]) -> bool:
    """Whether a publisher's header says that its last message is kept for later subscribers."""
    return fields.get("latching") == "1"


class HeaderReader:
    """Takes a publisher's header and nothing else; its connection is then to be aborted.

    Attributes:
        fields: The header; empty if the publisher refuses or the connection ends before it.
    """

    def __init__(self) -> None:
        self.fields: asyncio.Future[dict[str, str]] = asyncio.get_running_loop().create_future()

    def connection_made(self, connection: Connection) -> None:
        """Do nothing: the connecting side sends the header."""

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Take the header; messages that came with it are ignored."""
        if self.fields.done():
            return
        connection.header_done()
        try:
            fields = decode_header(payload)
        except TcprosError as error:
            _log.debug("%s: %s", connection, error)
            fields = {}
        self.fields.set_result(fields)

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Wake the task that waits for the header."""
        del connection, error  # the only connection
        if not self.fields.done():
            self.fields.set_result({})

    def writable(self, connection: Connection) -> None:
        """Do nothing: nothing waits to be written."""


class InputLink:
    """One publisher of a topic; owns the connection to it."""

    transport = "TCPROS"

    def __init__(self, target: TopicInput, uri: str) -> None:
        self.uri = uri
        self.messages = 0
        self.bytes_in = 0
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when the connection is gone; failed if the publisher refused."""
        self.publisher = ""
        """The publishing node's name, once it said so."""
        self.md5sum = ANY
        """Checksum of the published type, once the publisher said so."""
        self._target = target
        self._connection: Connection | None = None
        self.is_greeted = False
        """Whether the publisher has answered."""
        self.kept: bytes | None = None
        """The newest message of a latching publisher."""
        self.in_doubt: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        """Whether the first message waits for :meth:`settle`; done when that came or none will come."""
        self._latched = False
        self._waiting: list[bytes] | None = None

    def connection_made(self, connection: Connection) -> None:
        """Keep it, to end it: the connecting side sends the header."""
        self._connection = connection

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Take the publisher's header, then messages."""
        if self.is_greeted:
            self.messages += 1
            self.bytes_in += len(payload)
            if not self.in_doubt.done():
                self._take_first(connection)
            if self._waiting is None:
                self._deliver(payload)
            else:
                self._waiting.append(payload)
            return
        self.is_greeted = True
        try:
            self._greet(decode_header(payload))
        except TcprosError as error:
            self._end(error)
            connection.abort()
        else:
            connection.header_done()
            self._target.changed.set()

    def settle(self, connection: Connection, *, latched: bool) -> None:
        """Deliver what waits, now that it is known whether the publisher latches."""
        self._latched = latched
        waiting, self._waiting = self._waiting or [], None
        for payload in waiting:
            self._deliver(payload)
        connection.resume_reading()

    def refuse(self, error: HandshakeRefusedError) -> None:
        """End the connection from this side: nothing more is delivered."""
        self.kept = None
        if self._waiting:
            self._waiting = []
        self._end(error)
        if self._connection is not None:
            self._connection.abort()

    def _take_first(self, connection: Connection) -> None:
        """Hold the first message if it may be latched although the publisher's header did not say so."""
        in_doubt = not self._latched and self._target.tells_latched
        self.in_doubt.set_result(in_doubt)
        if in_doubt:
            self._waiting = []
            connection.pause_reading()

    def _deliver(self, payload: bytes) -> None:
        if self._latched:
            self.kept = payload
        self._target.deliver(payload, self._latched, self.uri)

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Wake the task that waits for the end."""
        del connection  # the only connection
        self._end(error)

    def writable(self, connection: Connection) -> None:
        """Do nothing: nothing waits to be written."""

    def _greet(self, fields: Mapping[str, str]) -> None:
        raise_error_field(fields)
        target = self._target
        check_type(
            fields, md5sum=target.md5sum, type_name=target.message_type_name, subject=f"topic {target.topic}"
        )
        self.publisher = fields.get("callerid", "")
        self.md5sum = fields.get("md5sum", ANY)
        self._latched = says_latching(fields)

    def _end(self, error: Exception | None) -> None:
        if self.ended.done():
            return
        if not self.in_doubt.done():
            self.in_doubt.set_result(False)
        if error is None:
            self.ended.set_result(None)
        else:
            self.ended.set_exception(error)
