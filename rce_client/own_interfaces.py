"""Methods that create a robot's own interfaces."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

from rce.model import AddInterface, ConfigureComponents, InterfaceSpec
from rce_client.services import ServiceClient, ServiceProvider
from rce_client.topics import Publisher, Subscriber

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce_client.interfaces import ClientInterface, LatchListener
    from rce_client.session import Session

InterfaceT = TypeVar("InterfaceT", bound="ClientInterface")

Json = dict[str, Any]
"""A message as an object of its fields; binary values are bytes-like."""
QUEUE_SIZE = 64
"""Messages that wait for a coroutine function or an iteration, unless a program says how many."""
Serialized = bytes | bytearray | memoryview
"""A serialized ROS message. A received one is a memoryview of its frame, not a copy."""


class OwnInterfaces:
    """Creates a robot's publishers, subscribers, service clients and service providers.

    The engine creates an interface shortly after these methods return, and keeps it until it is closed.
    :meth:`rce_client.Connection.wait_active` waits until it is connected to a peer. If the engine refuses an
    interface, ``on_error`` gets an error text.
    """

    robot_id: str
    _session: Session

    @overload
    async def publisher(
        self, tag: str, message_type: str, *, queue_size: int | None = ...
    ) -> Publisher[Json]: ...
    @overload
    async def publisher(
        self, tag: str, message_type: str, *, raw: Literal[True], queue_size: int | None = ...
    ) -> Publisher[Serialized]: ...
    async def publisher(
        self, tag: str, message_type: str, *, raw: bool = False, queue_size: int | None = None
    ) -> Publisher[Any]:
        """Create an interface of this robot that sends messages.

        Cancelling does not withdraw the request: the engine creates the interface. Call the method again with
        the same tag to get it.

        Args:
            tag: Interface tag.
            message_type: Message type, ``package/Type``.
            raw: Messages are serialized ROS messages (a Forwarder) instead of objects (a Converter).
            queue_size: How many messages may wait here, and on their way in the engine; a full queue drops
                the oldest. 1 is for commands of which only the newest counts. None: as many as the limits
                allow.

        Raises:
            InterfaceError: This program already has an interface with this tag.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            names = await robot.publisher("names", "std_msgs/String")
            await robot.connect("testRobot/names", "brain/names")
            await names.wait_active(timeout=30)
            names.publish({"data": "Ada"})
            ```
        """
        publisher = Publisher[Any](self._session, tag, message_type, raw=raw, queue_size=queue_size)
        return await self._open(publisher, queue_size or 0)

    @overload
    async def subscriber(
        self,
        tag: str,
        message_type: str,
        callback: Callable[[Json], Awaitable[None] | None] | None = None,
        *,
        queue_size: int | None = ...,
        latches: LatchListener[Json] | None = ...,
    ) -> Subscriber[Json]: ...
    @overload
    async def subscriber(
        self,
        tag: str,
        message_type: str,
        callback: Callable[[Serialized], Awaitable[None] | None] | None = None,
        *,
        raw: Literal[True],
        queue_size: int | None = ...,
        latches: LatchListener[Serialized] | None = ...,
    ) -> Subscriber[Serialized]: ...
    async def subscriber(
        self,
        tag: str,
        message_type: str,
        callback: Callable[[Any], Awaitable[None] | None] | None = None,
        *,
        raw: bool = False,
        queue_size: int | None = None,
        latches: LatchListener[Any] | None = None,
    ) -> Subscriber[Any]:
        """Create an interface of this robot that receives messages.

        Cancelling does not withdraw the request, as for :meth:`publisher`.

        Args:
            tag: Interface tag.
            message_type: Message type, ``package/Type``.
            callback: Called with each message. A plain function must not block; a coroutine function is
                awaited before the next message. Without a callback, iterate over the subscriber.
            raw: Messages are serialized ROS messages, as for :meth:`publisher`, each a memoryview.
            queue_size: How many messages may wait in the engine, and here for a coroutine function or an
                iteration; a full queue drops the oldest. 1 is for commands of which only the newest counts.
                None: 64 here, and as many as the engine's limits allow.
            latches: Gets the latched messages instead of the callback, if the engine marks them.

        Raises:
            InterfaceError: This program already has an interface with this tag.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            def show(message):
                print(message["data"])

            await robot.subscriber("greetings", "std_msgs/String", show)
            await robot.connect("brain/greetings", "testRobot/greetings")
            ```
        """
        subscriber = Subscriber[Any](
            self._session,
            tag,
            message_type,
            raw=raw,
            callback=callback,
            queue_size=queue_size or QUEUE_SIZE,
            latches=latches,
        )
        return await self._open(subscriber, queue_size or 0)

    @overload
    async def service_client(self, tag: str, message_type: str) -> ServiceClient[Json]: ...
    @overload
    async def service_client(
        self, tag: str, message_type: str, *, raw: Literal[True]
    ) -> ServiceClient[Serialized]: ...
    async def service_client(self, tag: str, message_type: str, *, raw: bool = False) -> ServiceClient[Any]:
        """Create an interface of this robot that calls a service.

        Cancelling does not withdraw the request, as for :meth:`publisher`.

        Args:
            tag: Interface tag.
            message_type: Service type, ``package/Type``.
            raw: Requests and answers are serialized ROS messages, as for :meth:`publisher`; received ones
                are memoryviews.

        Raises:
            InterfaceError: This program already has an interface with this tag.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            ask = await robot.service_client("ask", "Test/StringEcho")
            await robot.connect("testRobot/ask", "brain/echo")
            await ask.wait_active(timeout=30)
            print(await ask({"data": "hello"}))
            ```
        """
        return await self._open(ServiceClient[Any](self._session, tag, message_type, raw=raw))

    @overload
    async def service_provider(
        self,
        tag: str,
        message_type: str,
        handler: Callable[[Json], Awaitable[Json] | Json],
        *,
        max_calls: int = ...,
    ) -> ServiceProvider[Json]: ...
    @overload
    async def service_provider(
        self,
        tag: str,
        message_type: str,
        handler: Callable[[Serialized], Awaitable[Serialized] | Serialized],
        *,
        raw: Literal[True],
        max_calls: int = ...,
    ) -> ServiceProvider[Serialized]: ...
    async def service_provider(
        self,
        tag: str,
        message_type: str,
        handler: Callable[[Any], Awaitable[Any] | Any],
        *,
        raw: bool = False,
        max_calls: int = 64,
    ) -> ServiceProvider[Any]:
        """Create an interface of this robot that answers a service.

        Cancelling does not withdraw the request, as for :meth:`publisher`.

        Args:
            tag: Interface tag.
            message_type: Service type, ``package/Type``.
            handler: Called with a request; returns the answer. A plain function must not block; coroutine
                functions run concurrently. Its exceptions are logged, and the caller gets their text as the
                error.
            raw: Requests and answers are serialized ROS messages, as for :meth:`publisher`; received ones
                are memoryviews.
            max_calls: How many calls are handled at the same time; further calls get an error.

        Raises:
            InterfaceError: This program already has an interface with this tag.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            async def shout(request):
                return {"data": request["data"].upper()}

            await robot.service_provider("shout", "Test/StringEcho", shout)
            await robot.connect("brain/shout", "testRobot/shout")
            ```
        """
        return await self._open(
            ServiceProvider[Any](self._session, tag, message_type, handler, raw=raw, max_calls=max_calls)
        )

    async def _open(self, interface: InterfaceT, queue_size: int = 0) -> InterfaceT:
        """Ask the engine for an interface, in whose queues there so many messages may wait."""
        session = self._session
        session.check_open()
        session.interfaces.add(interface)
        added = AddInterface(
            endpoint=self.robot_id,
            interface=InterfaceSpec(
                tag=interface.tag,
                type=interface.interface_type,
                message_type=interface.message_type,
                queue_size=queue_size,
            ),
        )
        try:
            await session.request(ConfigureComponents(add_interfaces=(added,)))
        except asyncio.CancelledError:  # the program has no hold of it, and may make it again
            session.interfaces.remove(interface)
            raise
        return interface
