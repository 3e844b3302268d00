"""The node: a peer of a ROS graph, and the methods that a program calls on it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rce.ros.node.clock import NANOSECONDS
from rce.ros.node.hosting import hosted_program, program_arguments, program_environ
from rce.ros.node.member import DEFAULT_QUEUE, GraphMember
from rce.ros.node.parameters import REQUIRED, ParameterCallback
from rce.ros.node.publisher import Publisher
from rce.ros.node.runtime import TypeName
from rce.ros.node.service import Handler, SerializedHandler, Service, coding
from rce.ros.node.service_client import ServiceClient, answers
from rce.ros.node.settings import NodeSettings, queue_items
from rce.ros.node.subscriber import (
    ListenerSink,
    MessageCallback,
    QueueSink,
    SerializedCallback,
    Sink,
    Subscriber,
    TopicListener,
    decoding,
    sink_for,
)
from rce.ros.node.timing import Rate, Timer, TimerCallback
from rce.ros.tcpros.header import ANY

if TYPE_CHECKING:
    from rce.ros.types import MessageType, ServiceType, Time, TypeRegistry

SERVICE_POLL = 0.1
"""Seconds between two looks for a service that is not there yet."""


class Node(GraphMember):
    """A ROS node. An async context manager: it is part of the graph inside its block.

    ``async with Node("listener") as node: await node.subscribe("chatter", "std_msgs/String", print)``

    Leaving the block unregisters everything and closes all connections. A node that is told to stop (by
    the master, by ``rosnode kill`` or by a signal) ends its iterators, :meth:`spin` and :meth:`sleep`; the
    program then leaves the block.

    All names may be global, relative or private and are remapped. Types are given by name or as objects.

    Attributes:
        log: A logger whose records go to ``/rosout`` too.
    """

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "",
        argv: Sequence[str] | None = None,
        master_uri: str | None = None,
        types: TypeRegistry | None = None,
        anonymous: bool = False,
        signals: bool | None = None,
        master_timeout: float | None = 10.0,
        intra_process: bool = True,
        rosout: bool = True,
    ) -> None:
        """Prepare a node.

        Args:
            name: Its name without namespace.
            namespace: Its namespace; if empty, ``ROS_NAMESPACE``.
            argv: Command line with remappings; ``None`` takes the program's own.
            master_uri: The master; if ``None``, ``ROS_MASTER_URI``.
            types: Where types come from; if ``None``, those that are built in.
            anonymous: Make the name unique.
            signals: Stop the node at SIGINT and SIGTERM; ``None`` means: if it is the program's main node,
                which is the one that takes the program's command line.
            master_timeout: Seconds to wait for a master that is not up yet; ``None`` waits without a limit.
                One that takes the request but is too busy to answer is waited for up to a minute, unless this
                is 0.
            intra_process: Take messages of other nodes of this process as the objects that they published,
                which then must not be changed; else by a connection, as from any node.
            rosout: Publish the log on ``/rosout``.

        Raises:
            InvalidNameError: A name or remapping is not legal.
        """
        settings = NodeSettings.gather(
            name,
            namespace=namespace,
            argv=program_arguments() if argv is None else argv,
            environ=program_environ(),
            master_uri=master_uri,
            anonymous=anonymous,
        )
        handle_signals = argv is None if signals is None else signals
        super().__init__(
            settings,
            types,
            signals=handle_signals,
            master_timeout=master_timeout,
            intra_process=intra_process,
            rosout=rosout,
        )
        program = hosted_program()
        if program is not None:
            program.add(self)

    def resolve(self, name: str) -> str:
        """Return the global name that ``name`` stands for, after remapping.

        Raises:
            InvalidNameError: It is not legal.
        """
        return self._settings.resolver.resolve(name)

    # Topics

    async def advertise(
        self,
        topic: str,
        message_type: str | MessageType,
        *,
        latch: bool = False,
        queue_size: int = DEFAULT_QUEUE,
    ) -> Publisher:
        """Publish on a topic.

        Args:
            topic: The topic.
            message_type: Its type.
            latch: Give the last message to later subscribers.
            queue_size: How many messages wait for a slow subscriber before its oldest is dropped; 0: as many
                as 64 MiB hold.

        Raises:
            TypeMismatchError: This node publishes the topic with another type.
            UnknownTypeError: The type does not exist.
            MasterError: The registration at the master failed.
        """
        runtime = self._running
        known = runtime.types.message(message_type)
        return await self._topics.advertise(
            runtime, self.resolve(topic), known, latch=latch, queue_size=queue_items(queue_size)
        )

    async def subscribe(
        self,
        topic: str,
        message_type: str | MessageType,
        callback: MessageCallback | None = None,
        *,
        queue_size: int = DEFAULT_QUEUE,
    ) -> Subscriber:
        """Take the messages of a topic.

        Args:
            topic: The topic.
            message_type: Its type.
            callback: Called with each message, in order. A plain function is called as soon as a message is
                there and must not block; a coroutine function is awaited before the next message. Without
                a callback, iterate over the subscriber.
            queue_size: How many messages wait for a coroutine or an iteration before the oldest is dropped;
                0: as many as 64 MiB hold.

        Raises:
            TypeMismatchError: This node subscribes to the topic with another type.
            UnknownTypeError: The type does not exist.
            MasterError: The registration at the master failed.
        """
        runtime = self._running
        name, items = self.resolve(topic), queue_items(queue_size)
        known = runtime.types.message(message_type)
        if callback is None:
            return await self._topics.subscribe(runtime, name, known, QueueSink(items), decodes=True)
        sink = sink_for(decoding(known, callback), items, name, runtime.tasks)
        return await self._topics.subscribe(runtime, name, known, sink, decodes=True)

    async def subscribe_serialized(
        self,
        topic: str,
        message_type: str | MessageType | TypeName,
        callback: SerializedCallback,
        *,
        queue_size: int = DEFAULT_QUEUE,
    ) -> Subscriber:
        """Take the messages of a topic as they are on the wire.

        Args:
            topic: The topic.
            message_type: Its type; ``*`` for any. A :class:`~rce.ros.node.runtime.TypeName` saves loading it.
            callback: Called with ``(payload, latched)``; ``latched`` is what the publisher says of itself.
                Plain function or coroutine function, as for :meth:`subscribe`.
            queue_size: As for :meth:`subscribe`.

        Raises:
            TypeMismatchError: This node subscribes to the topic with another type.
            UnknownTypeError: The type does not exist.
            MasterError: The registration at the master failed.
        """
        name = self.resolve(topic)
        sink = sink_for(callback, queue_items(queue_size), name, self._running.tasks)
        return await self._subscribe_raw(name, message_type, sink)

    async def _subscribe_raw(
        self, name: str, message_type: str | MessageType | TypeName, sink: Sink, *, hears_own: bool = True
    ) -> Subscriber:
        runtime = self._running
        known: MessageType | TypeName | None = None
        if message_type != ANY:
            known = (
                message_type if isinstance(message_type, TypeName) else runtime.types.message(message_type)
            )
        return await self._topics.subscribe(runtime, name, known, sink, decodes=False, hears_own=hears_own)

    async def listen(
        self, topic: str, message_type: str | MessageType | TypeName, listener: TopicListener
    ) -> Subscriber:
        """Take the serialized messages of a topic for a bridge, without those of this node itself.

        Args:
            topic: The topic.
            message_type: As for :meth:`subscribe_serialized`, and so is what is raised.
            listener: Takes the messages, at once and in order; must not block.
        """
        name = self.resolve(topic)
        return await self._subscribe_raw(name, message_type, ListenerSink(listener, name), hears_own=False)

    # Services

    async def advertise_service(
        self, name: str, service_type: str | ServiceType, handler: Handler
    ) -> Service:
        """Provide a service.

        Args:
            name: The service.
            service_type: Its type.
            handler: Called with each request; returns a response or a mapping of its fields. A plain function
                must not block; coroutine functions run side by side for different clients. Exceptions are
                sent to the caller: :class:`~rce.ros.errors.ServiceFaultError` with its text; any other is
                logged too.

        Raises:
            TypeMismatchError: This node provides the service already.
            UnknownTypeError: The type does not exist.
            MasterError: The registration at the master failed.
        """
        known = self._running.types.service(service_type)
        return await self._provide(self.resolve(name), known, coding(known, handler))

    async def advertise_service_serialized(
        self, name: str, service_type: str | ServiceType, handler: SerializedHandler
    ) -> Service:
        """Provide a service whose requests and responses are passed as they are on the wire.

        Raises:
            TypeMismatchError: This node provides the service already.
            UnknownTypeError: The type does not exist.
            MasterError: The registration at the master failed.
        """
        return await self._provide(self.resolve(name), self._running.types.service(service_type), handler)

    def service_client(
        self, name: str, service_type: str | ServiceType, *, persistent: bool = True
    ) -> ServiceClient:
        """Make a client of a service, which need not be there yet; close it when it is not needed any more.

        Args:
            name: The service.
            service_type: Its type.
            persistent: Keep connections for later calls; else every call looks the provider up again.

        Raises:
            UnknownTypeError: The type does not exist.
        """
        runtime = self._running
        client = ServiceClient(
            runtime,
            self.resolve(name),
            runtime.types.service(service_type),
            self._clients.discard,
            persistent=persistent,
        )
        self._clients.add(client)
        return client

    async def wait_for_service(self, name: str, *, timeout: float | None = None) -> None:
        """Wait until a service has a provider that answers.

        Raises:
            TimeoutError: No provider answered within ``timeout`` seconds.
            MasterError: The master cannot be asked.
            NodeClosedError: The node was told to stop.
        """
        runtime, service = self._running, self.resolve(name)
        async with asyncio.timeout(timeout):
            while not await answers(runtime, service):
                runtime.check_running()
                await asyncio.sleep(SERVICE_POLL)  # a master announces no services

    # Time

    @property
    def is_time_simulated(self) -> bool:
        """Whether time comes from ``/clock``: parameter ``/use_sim_time`` was true when the node started."""
        return self._clock.simulated

    def now(self) -> Time:
        """Return ROS time as messages carry it. Simulated time is zero until the first tick."""
        from rce.ros.types import Time

        return Time(*divmod(self._clock.nanoseconds(), NANOSECONDS))

    def time(self) -> float:
        """Return ROS time in seconds since the epoch."""
        return self._clock.nanoseconds() / NANOSECONDS

    def rate(self, hz: float) -> Rate:
        """Make a rate, which keeps a loop's pace in ROS time: ``async for _ in node.rate(10): ...``."""
        return Rate(self._clock, hz)

    def timer(self, period: float, callback: TimerCallback, *, oneshot: bool = False) -> Timer:
        """Call a function every ``period`` seconds of ROS time, or once.

        Args:
            period: Seconds; the first call is after the first period.
            callback: Called with a :class:`~rce.ros.node.timing.TimerEvent`; a coroutine function is awaited.
            oneshot: Call it only once.
        """
        return Timer(self._clock, period, callback, self._running.tasks, oneshot=oneshot)

    # Parameters

    async def get_param(self, name: str, default: Any = REQUIRED) -> Any:
        """Return a parameter, or all of a namespace as a dictionary.

        Raises:
            ParameterMissingError: It is not set, and ``default`` is not given.
            MasterUnreachableError: The master does not answer.
        """
        return await self._parameters.get(self.resolve(name), default)

    async def get_param_cached(self, name: str, default: Any = REQUIRED) -> Any:
        """Return a parameter from a cache: the first call asks the master, which then reports changes.

        Raises:
            ParameterMissingError: It is not set or an empty namespace, and ``default`` is not given.
            MasterUnreachableError: The master does not answer.
        """
        return await self._parameters.get_cached(self.resolve(name), default)

    async def set_param(self, name: str, value: Any) -> None:
        """Set a parameter, or a whole namespace from a dictionary.

        Raises:
            ParameterValueError: XML-RPC has no form for the value, or for one in it; nothing was set.
            MasterUnreachableError: The master does not answer.
        """
        await self._parameters.set(self.resolve(name), value)

    async def has_param(self, name: str) -> bool:
        """Return whether a parameter or namespace is set."""
        return await self._parameters.has(self.resolve(name))

    async def delete_param(self, name: str) -> None:
        """Delete a parameter or namespace.

        Raises:
            ParameterMissingError: It is not set.
        """
        await self._parameters.delete(self.resolve(name))

    async def search_param(self, name: str) -> str | None:
        """Look for a relative name in the node's namespace and then upwards; return the global name."""
        return await self._parameters.search(name)

    async def get_param_names(self) -> list[str]:
        """Return the names of all parameters of the graph."""
        return await self._parameters.all_names()

    async def watch_param(self, name: str, callback: ParameterCallback) -> Any:
        """Call ``callback(name, value)`` whenever a parameter, or one below it, is changed by another node.

        Returns:
            The value now; an empty dictionary while it is not set.
        """
        return await self._parameters.watch(self.resolve(name), callback)
