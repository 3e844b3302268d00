"""Calling services over connections that are kept for the next call."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rce.ros.dialing import open_peer_socket
from rce.ros.errors import (
    HandshakeRefusedError,
    MalformedFrameError,
    NodeClosedError,
    ServiceFaultError,
    ServiceLostError,
    ServiceNotFoundError,
    ServiceTimeoutError,
)
from rce.ros.node.runtime import Runtime
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import frame
from rce.ros.tcpros.header import ANY, check_type, decode_header, encode_header, raise_error_field

if TYPE_CHECKING:
    from rce.ros.types import Message, ServiceType

MAX_ACTIVE = 64
"""How many calls of one client are under way at once; more wait."""

MAX_IDLE = MAX_ACTIVE
"""How many idle connections a client keeps: one for each call of a burst, so that the next opens none."""

PROBE_S = 10.0
"""Seconds in which a provider has to answer one who only asks whether it is there."""


class ServiceClient:
    """Calls one service. Made by :meth:`rce.ros.node.Node.service_client`.

    Any number of calls may run at once. A connection carries one call at a time and is kept for later ones
    while it lasts; when it is lost, the provider is looked up again.
    """

    def __init__(
        self,
        runtime: Runtime,
        name: str,
        service_type: ServiceType,
        release: Callable[[ServiceClient], None],
        *,
        persistent: bool,
    ) -> None:
        self.name = name
        """The service's global name."""
        self.type = service_type
        self._runtime = runtime
        self._release = release
        self._persistent = persistent
        self._idle: list[_Call] = []
        self._open: set[_Call] = set()
        self._slots = asyncio.Semaphore(MAX_ACTIVE)
        self._closed = False

    async def __call__(self, request: Message | Mapping[str, Any] | None = None, /, **fields: Any) -> Message:
        """Call the service with a request, or with its fields; without a time limit.

        Raises:
            ServiceError: The call got no response; the subclasses give the reason.
            TypeError: There are a request and fields; a ``timeout`` is an argument of :meth:`call`.
        """
        if request is None:
            return await self.call(self.type.request.new(**fields))
        if fields:
            raise TypeError(
                f"service {self.name}: give a request or its fields, not both ({', '.join(fields)});"
                " call(request, timeout=...) has a time limit"
            )
        return await self.call(request)

    async def call(self, request: Message | Mapping[str, Any], *, timeout: float | None = None) -> Message:
        """Call the service.

        Args:
            request: A request or a mapping of its fields.
            timeout: Seconds, of everything.

        Raises:
            ServiceError: The call got no response; the subclasses give the reason.
            SerializationError: The request does not fit its type.
        """
        payload = self.type.request.serialize(request)
        return self.type.response.deserialize(await self.call_serialized(payload, timeout=timeout))

    async def call_serialized(
        self,
        payload: bytes | bytearray | memoryview,
        *,
        timeout: float | None = None,
    ) -> bytes:
        """Call the service with a serialized request; return the serialized response.

        A call that is cancelled or times out closes its connection, so its late answer is discarded. One that
        times out closes the idle connections too: their provider may be gone without a word.

        Raises:
            ServiceNotFoundError: The service has no provider.
            ServiceLostError: The provider cannot be reached or went away before it answered.
            ServiceFaultError: The provider answered with an error.
            ServiceTimeoutError: No answer within ``timeout`` seconds.
        """
        self._check_open()
        try:
            async with asyncio.timeout(timeout), self._slots:
                self._check_open()
                return await self._exchange(payload)
        except TimeoutError as error:
            await self._drop_idle()
            raise ServiceTimeoutError(self.name) from error

    async def close(self) -> None:
        """Close the kept connections; calls under way end with ServiceLostError.

        The node keeps a client until it is closed.
        """
        self._closed = True
        self._release(self)
        for call in list(self._open):
            await call.close()

    def _check_open(self) -> None:
        if self._closed:
            raise NodeClosedError(f"the client of {self.name} is closed")

    async def _exchange(self, payload: bytes | bytearray | memoryview) -> bytes:
        call = self._take_idle() or await self._connect()
        try:
            answer = await call.ask(payload)
        except ServiceFaultError:
            await self._give_back(call)
            raise
        except BaseException:
            self._open.discard(call)
            await call.close()
            raise
        await self._give_back(call)
        return answer

    def _take_idle(self) -> _Call | None:
        while self._idle:
            call = self._idle.pop()
            if call.connection.is_open:
                return call
            self._open.discard(call)
        return None

    async def _drop_idle(self) -> None:
        idle, self._idle = self._idle, []
        for call in idle:
            self._open.discard(call)
            await call.close()

    async def _give_back(self, call: _Call) -> None:
        if self._persistent and not self._closed and len(self._idle) < MAX_IDLE:
            self._idle.append(call)
        else:
            self._open.discard(call)
            await call.close()

    async def _connect(self) -> _Call:
        uri = await self._runtime.master.lookup_service(self.name)
        if uri is None:
            raise ServiceNotFoundError(self.name)
        call = await _Call.open(self.name, uri, self._runtime.scratch)
        self._open.add(call)
        try:
            self._check_open()  # it was closed while this connected
            await self._greet(call)
        except BaseException:
            self._open.discard(call)
            await call.close()
            raise
        return call

    async def _greet(self, call: _Call) -> None:
        header = {
            "callerid": self._runtime.name,
            "service": self.name,
            "type": self.type.name,
            "md5sum": self.type.md5sum,
        }
        if self._persistent:
            header["persistent"] = "1"
        try:
            answer = decode_header(await call.exchange((encode_header(header),)))
            raise_error_field(answer)
            check_type(
                answer, md5sum=self.type.md5sum, type_name=self.type.name, subject=f"service {self.name}"
            )
        except HandshakeRefusedError as error:
            raise ServiceFaultError(self.name, str(error)) from error
        except MalformedFrameError as error:
            raise ServiceLostError(self.name, f"the provider answers in no known form: {error}") from error
        call.connection.header_done(has_lead=True)


async def answers(runtime: Runtime, name: str) -> bool:
    """Return whether a service has a provider that can be reached and answers."""
    uri = await runtime.master.lookup_service(name)
    if uri is None:
        return False
    probe = {"callerid": runtime.name, "service": name, "md5sum": ANY, "probe": "1"}
    try:
        async with asyncio.timeout(PROBE_S):
            call = await _Call.open(name, uri, runtime.scratch)
            try:
                return "error" not in decode_header(await call.exchange((encode_header(probe),)))
            finally:
                await call.close()
    except (ServiceLostError, MalformedFrameError, TimeoutError):
        return False


class _Call:
    """A connection to a provider, for one call at a time; owns the connection."""

    def __init__(self, service: str) -> None:
        self.connection: Connection
        self._service = service
        self._answer: asyncio.Future[bytes] | None = None

    @classmethod
    async def open(cls, service: str, uri: str, scratch: memoryview) -> _Call:
        """Connect to a ``rosrpc`` URI."""
        call = cls(service)
        loop = asyncio.get_running_loop()
        try:
            address = urlsplit(uri)
            host, port = address.hostname, address.port
            if host is None or port is None:
                raise ServiceLostError(
                    service, f"the provider's URI {uri!r} is not of the form rosrpc://host:port"
                )
            _, call.connection = await loop.create_connection(
                lambda: Connection(call, scratch), sock=await open_peer_socket(host, port)
            )
        except (OSError, ValueError) as error:
            raise ServiceLostError(service, f"the provider at {uri} cannot be reached: {error}") from error
        return call

    async def ask(self, payload: bytes | bytearray | memoryview) -> bytes:
        """Send a request and wait for the answer."""
        return await self.exchange(frame(payload))

    async def exchange(self, chunks: tuple[bytes, ...]) -> bytes:
        """Send a frame and wait for the one that answers it."""
        if not self.connection.is_open:
            raise ServiceLostError(self._service)
        self._answer = asyncio.get_running_loop().create_future()
        try:
            self.connection.write(chunks)
            return await self._answer
        finally:
            self._answer = None

    async def close(self) -> None:
        """Close the connection and wait until it is closed."""
        self.connection.abort()
        await self.connection.gone.wait()

    def connection_made(self, connection: Connection) -> None:
        """Do nothing: the connecting side sends the header."""

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Give the answer to the waiting call."""
        if self._answer is None or self._answer.done():
            connection.abort()  # no call waits for an answer
        elif connection.reader.lead:
            self._answer.set_result(payload)
        else:
            self._answer.set_exception(ServiceFaultError(self._service, payload.decode(errors="replace")))

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Fail the call that waits for an answer."""
        del connection  # the only connection
        if self._answer is not None and not self._answer.done():
            lost = ServiceLostError(self._service)
            lost.__cause__ = error
            self._answer.set_exception(lost)

    def writable(self, connection: Connection) -> None:
        """Do nothing: nothing waits to be written."""
