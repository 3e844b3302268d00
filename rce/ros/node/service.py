"""Providing services: requests in, answers out, in order on each connection, side by side on several."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any

from rce.aio.tasks import pass_cancellation
from rce.ros.errors import ServiceFaultError
from rce.ros.node.runtime import Runtime
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import Chunks, answer_frame
from rce.ros.tcpros.header import check_type, encode_header, require

if TYPE_CHECKING:
    from rce.ros.types import ServiceType

_log = logging.getLogger(__name__)

Handler = Callable[[Any], Any]
"""Takes a request; returns (or, being a coroutine function, awaits) a response, as an object or mapping."""

SerializedHandler = Callable[[bytes], bytes | Awaitable[bytes]]


def coding(service_type: ServiceType, handler: Handler) -> SerializedHandler:
    """Turn a handler of requests into one of their bytes."""

    def encode(response: Any) -> bytes:
        return service_type.response.serialize({} if response is None else response)

    async def finish(response: Awaitable[Any]) -> bytes:
        return encode(await response)

    def decode(payload: bytes) -> bytes | Awaitable[bytes]:
        response = handler(service_type.request.deserialize(payload))
        return finish(response) if inspect.isawaitable(response) else encode(response)

    return decode


class Service:
    """A service that the node provides. Made by :meth:`rce.ros.node.Node.advertise_service`."""

    def __init__(
        self,
        runtime: Runtime,
        name: str,
        service_type: str | ServiceType,
        handler: SerializedHandler,
        release: Callable[[Service], Awaitable[None]],
    ) -> None:
        self.name = name
        """The service's global name."""
        self.calls = 0
        """How many requests came."""
        self._runtime = runtime
        self._service_type = service_type
        self._handler = handler
        self._release = release
        self._sessions: set[Session] = set()
        self._closed = False

    @property
    def type(self) -> ServiceType:
        """The service's type."""
        if isinstance(self._service_type, str):
            self._service_type = self._runtime.types.service(self._service_type)
        return self._service_type

    def accept(self, connection: Connection, fields: Mapping[str, str]) -> None:
        """Take a client.

        Raises:
            HandshakeRefusedError: It expects another type.
        """
        require(fields, "md5sum")
        check_type(fields, md5sum=self.type.md5sum, type_name=self.type.name, subject=f"service {self.name}")
        reply = {
            "callerid": self._runtime.name,
            "service": self.name,
            "type": self.type.name,
            "md5sum": self.type.md5sum,
            "request_type": self.type.request.name,
            "response_type": self.type.response.name,
        }
        connection.write((encode_header(reply),))
        if fields.get("probe") == "1":
            connection.close()
            return
        connection.header_done()
        session = Session(self, connection, persistent=fields.get("persistent", "").lower() in ("1", "true"))
        connection.owner = session
        self._sessions.add(session)

    def drop(self, session: Session) -> None:
        """Forget a client that is gone."""
        self._sessions.discard(session)

    def answer(self, payload: bytes) -> Chunks | Awaitable[Chunks]:
        """Handle one request; never raises."""
        self.calls += 1
        try:
            response = self._handler(payload)
        except Exception as error:  # noqa: BLE001 - the caller gets every failure
            return self._failure(error)
        return answer_frame(response, ok=True) if isinstance(response, bytes) else self._finish(response)

    def in_background(self, work: Awaitable[Chunks], session: Session) -> None:
        """Handle a request that takes time."""
        self._runtime.tasks.spawn(session.finish(work), name=f"service {self.name}")

    async def close(self) -> None:
        """Stop providing the service: unregister it and disconnect its clients."""
        if not self._closed:
            self._closed = True
            self.disconnect()
            await self._release(self)

    def disconnect(self) -> None:
        """Disconnect the clients; calls under way are not answered."""
        for session in self._sessions:
            session.connection.close()

    async def _finish(self, response: Awaitable[bytes]) -> Chunks:
        try:
            return answer_frame(await response, ok=True)
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the caller gets every failure
            pass_cancellation(error)
            return self._failure(error)

    def _failure(self, error: BaseException) -> Chunks:
        if isinstance(error, ServiceFaultError):
            text = error.text
        else:
            _log.error("service %s failed", self.name, exc_info=error)
            text = f"error processing request: {str(error) or type(error).__name__}"
        # The name of a file, or a text from JSON, may hold what UTF-8 cannot.
        return answer_frame(text.encode(errors="backslashreplace"), ok=False)


class Session:
    """One client of a service; owns the connection."""

    def __init__(self, service: Service, connection: Connection, *, persistent: bool) -> None:
        self.connection = connection
        self._service = service
        self._persistent = persistent
        self._busy = False
        self._waiting: deque[bytes] = deque()

    def connection_made(self, connection: Connection) -> None:
        """Do nothing: a session begins when the header came."""

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Handle a request, or keep it until those before it are answered and the client reads."""
        self._waiting.append(payload)
        self._handle_waiting()
        if self._waiting:
            connection.pause_reading()

    async def finish(self, work: Awaitable[Chunks]) -> None:
        """Answer a request that takes time, and the requests that came meanwhile."""
        self._reply(await work)
        self._busy = False
        self._continue()

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Forget the client; the handling of its requests continues to the end."""
        del connection, error  # a client may leave
        self._waiting.clear()
        self._service.drop(self)

    def writable(self, connection: Connection) -> None:
        """Handle the requests that came while the client did not read its answers."""
        del connection  # its own
        self._continue()

    def _continue(self) -> None:
        self._handle_waiting()
        if not self._waiting:
            self.connection.resume_reading()

    def _handle_waiting(self) -> None:
        connection = self.connection
        while self._waiting and not self._busy and not connection.full and connection.is_open:
            answer = self._service.answer(self._waiting.popleft())
            if isinstance(answer, tuple):
                self._reply(answer)
            else:
                self._busy = True
                self._service.in_background(answer, self)

    def _reply(self, chunks: Chunks) -> None:
        self.connection.write(chunks)
        if not self._persistent:
            self.connection.close()
