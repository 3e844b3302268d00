"""Membership in a ROS graph: joining, being told to stop, leaving."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rce.aio.tasks import TaskScope, run_in_groups
from rce.ros.errors import (
    HandshakeRefusedError,
    MasterError,
    MasterUnreachableError,
    NodeClosedError,
    TypeMismatchError,
)
from rce.ros.logfiles import LogFile
from rce.ros.node import clock, rosout
from rce.ros.node.clock import NANOSECONDS, Clock
from rce.ros.node.local import neighbour
from rce.ros.node.loggers import Loggers
from rce.ros.node.master import MasterClient
from rce.ros.node.parameters import Parameters
from rce.ros.node.registrar import Registrar
from rce.ros.node.registrations import BUSY_S, Registrations
from rce.ros.node.running import stop_signals
from rce.ros.node.runtime import Runtime, Types
from rce.ros.node.service import SerializedHandler, Service
from rce.ros.node.service_client import ServiceClient
from rce.ros.node.settings import NodeSettings
from rce.ros.node.slave import NOTHING, SlaveApi
from rce.ros.node.subscriber import CallbackSink
from rce.ros.node.topics import Topics
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import SCRATCH_SIZE
from rce.ros.tcpros.listener import Listener
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer

if TYPE_CHECKING:
    from rce.ros.types import ServiceType, TypeRegistry

_log = logging.getLogger(__name__)

DEFAULT_QUEUE = 100
"""How many messages wait for a slow peer before the oldest is dropped."""

GOODBYE_TIMEOUT = 3.0
"""Seconds that the master may take to remove a node's registrations."""

CLOSED_AT_ONCE = 500
"""How many topics are unregistered side by side, in requests of several."""

LOG_FORM = "[%(name)s][%(levelname)s] %(asctime)s: %(message)s"
WARNING_FORM = "%(levelname)s %(name)s: %(message)s"
LOG_BYTES = 50_000_000
LOG_BACKUPS = 4
"""Form, length and number of older ones of a node's own log file: as rospy's."""

RETRY = 0.2
"""Seconds between attempts to reach the master."""


class GraphMember:
    """The life cycle of a node; :class:`rce.ros.node.Node` adds the methods for programs."""

    def __init__(
        self,
        settings: NodeSettings,
        types: TypeRegistry | None,
        *,
        signals: bool,
        master_timeout: float | None,
        intra_process: bool,
        rosout: bool,
    ) -> None:
        self.log = logging.getLogger("ros" + settings.resolver.node_name.replace("/", "."))
        self._settings = settings
        self._types = Types(types)
        if self.log.level == logging.NOTSET:
            self.log.setLevel(logging.INFO)  # independent of the logging of the node's program
        self._signals = signals
        self._intra_process = intra_process
        self._rosout = rosout
        self._clock = Clock()
        self._master_timeout = master_timeout
        self._topics = Topics()
        self._services: dict[str, Service] = {}
        self._clients: set[ServiceClient] = set()
        self._stop = asyncio.Event()
        self._stack = AsyncExitStack()
        self._runtime: Runtime | None = None
        self._parameters: Parameters
        self._listener: Listener

    # For programs

    @property
    def name(self) -> str:
        """The node's global name."""
        return self._settings.resolver.node_name

    @property
    def namespace(self) -> str:
        """The node's namespace, with a trailing slash."""
        return self._settings.resolver.namespace

    @property
    def master_uri(self) -> str:
        """The master's URI."""
        return self._settings.master_uri

    @property
    def uri(self) -> str:
        """The URI of the node's own API."""
        return self._running.master.slave_uri

    @property
    def service_uri(self) -> str:
        """The ``rosrpc`` URI under which the node provides its services."""
        return f"rosrpc://{self._settings.host}:{self._listener.port}"

    @property
    def is_shutdown(self) -> bool:
        """Whether the node was told to stop."""
        return self._stop.is_set()

    def shutdown(self, reason: str = "the program asked for it") -> None:
        """Tell the node to stop: iterators, :meth:`spin`, :meth:`sleep` and waits for other nodes end."""
        if not self._stop.is_set():
            _log.info("%s stops: %s", self.name, reason)
            self._stop.set()
            self._clock.end()
            for source in self._topics.inputs.values():
                source.changed.set()
                for subscriber in source.subscribers:
                    subscriber.sink.end()
            for output in self._topics.outputs.values():
                output.changed.set()

    def _stop_for_others(self, reason: str) -> None:
        """Stop because another program says so, such as the core when a second node takes this one's name."""
        if not self.is_shutdown:
            _log.warning("%s has to stop: %s", self.name, reason)
        self.shutdown(reason)

    async def spin(self) -> None:
        """Wait until the node is told to stop, by the master, another node or a signal."""
        if self._signals:
            await self._stop.wait()
            return
        with stop_signals(self.shutdown):
            await self._stop.wait()

    async def until_shutdown(self) -> None:
        """Wait until the node is told to stop, as :meth:`spin`; signals are left to the program.

        Example:
            ```python
            await node.until_shutdown()
            ```
        """
        await self._stop.wait()

    async def sleep(self, seconds: float) -> bool:
        """Sleep in ROS time, or wake up early because the node is told to stop or simulated time jumps back.

        Returns:
            Whether the node continues: ``while await node.sleep(0.1): ...``.
        """
        return await self._clock.sleep_until(self._clock.nanoseconds() + round(seconds * NANOSECONDS))

    async def reregister(self) -> None:
        """Tell the master again of all topics and services, at once.

        A node does so by itself when its master was restarted.

        Raises:
            MasterError: The registration at the master failed.
        """
        await self._registrar(self._running.master).register_all()

    # Life

    async def __aenter__(self) -> Self:
        settings = self._settings = await self._settings.placed()
        async with AsyncExitStack() as stack:
            scratch = memoryview(bytearray(SCRATCH_SIZE))
            rpc = await stack.enter_async_context(RpcClient())
            self._listener = await stack.enter_async_context(
                Listener(settings.bind, scratch, topic=self._topics.accept, service=self._accept_service)
            )
            tasks = await stack.enter_async_context(TaskScope())
            slave = SlaveApi(
                self.name,
                lambda: slave_uri,
                self._topics,
                settings.master_uri,
                lambda: (settings.host, self._listener.port),
                self._stop_for_others,
                self._parameter_changed,
            )
            dispatcher = Dispatcher(slave.methods(), NOTHING)
            server = await stack.enter_async_context(RpcServer(dispatcher, settings.bind))
            slave_uri = f"http://{settings.host}:{server.port}/"
            master = MasterClient(settings.master_uri, self.name, slave_uri, rpc)
            self._runtime = Runtime(
                self.name,
                self._types,
                tasks,
                rpc,
                master,
                Registrations(self.name, tasks),
                scratch,
                intra_process=self._intra_process,
                stopping=self._stop,
            )
            self._parameters = Parameters(master)
            if self._intra_process:
                stack.enter_context(neighbour(slave_uri, self._topics))
            stack.push_async_callback(self._leave_graph)
            await self._until_master_answers()
            await self._join_graph(stack)
            tasks.spawn(self._registrar(master).keep(), name=f"{self.name} stays registered")
            if self._signals:
                stack.enter_context(stop_signals(self.shutdown))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.shutdown("the program left the node's block")
        await self._stack.aclose()
        self._runtime = None

    async def _join_graph(self, stack: AsyncExitStack) -> None:
        """Do what every node does first."""
        if self._clock.simulated:
            sink = CallbackSink(self._clock.tick, clock.TOPIC)
            await self._topics.subscribe(self._running, clock.TOPIC, clock.CLOCK, sink, decodes=False)
        for name, value in self._private_parameters.items():
            await self._parameters.set(name, value)
        if self._rosout:
            await self._publish_log(stack)
        if self._settings.log_file is not None:
            self._keep_log(stack, self._settings.log_file)
        if self._settings.shows_warnings and not logging.getLogger().handlers:
            self._show_warnings(stack)
        for name, service_type, handler in Loggers(self.log).handlers(self._types):
            await self._provide(f"{self.name}/{name}", service_type, handler)

    async def _publish_log(self, stack: AsyncExitStack) -> None:
        publisher = await self._topics.advertise(
            self._running, rosout.TOPIC, rosout.KIND, latch=False, queue_size=DEFAULT_QUEUE
        )
        handler = rosout.RosoutHandler(publisher, self.name, self._clock, self._topics.names)
        publisher.on_subscriber = handler.flush
        self.log.addHandler(handler)
        stack.callback(self.log.removeHandler, handler)

    def _show_warnings(self, stack: AsyncExitStack) -> None:
        handler = logging.StreamHandler()
        handler.setLevel(logging.WARNING)
        handler.setFormatter(logging.Formatter(WARNING_FORM))
        self.log.addHandler(handler)
        stack.callback(self.log.removeHandler, handler)

    def _keep_log(self, stack: AsyncExitStack, path: Path) -> None:
        try:
            file = LogFile(path, LOG_FORM, max_bytes=LOG_BYTES, backups=LOG_BACKUPS)
        except OSError as error:
            _log.warning("%s has no log file %s: %s", self.name, path, error.strerror or error)
            return
        self.log.addHandler(file)
        stack.callback(file.close)
        stack.callback(self.log.removeHandler, file)

    async def _provide(
        self, name: str, service_type: str | ServiceType, handler: SerializedHandler
    ) -> Service:
        """Provide a service under a global name."""
        runtime, uri = self._running, self.service_uri
        if name in self._services:
            raise TypeMismatchError(f"this node provides {name} already")

        registration = runtime.registrations.begin(
            f"service {name}",
            register=partial(runtime.master.register_service, name, uri),
            unregister=partial(runtime.master.unregister_service, name, uri),
            is_needed=lambda: name in self._services,
        )

        async def release(service: Service) -> None:
            del self._services[service.name]
            await registration.release()

        service = self._services[name] = Service(runtime, name, service_type, handler, release)
        try:
            await registration.wait()
        except BaseException:
            if self._services.get(name) is service:  # it may have been closed while it waited
                del self._services[name]
                service.disconnect()
                registration.abandon()
            raise
        return service

    async def _until_master_answers(self) -> None:
        """Ask the master, which may not be up yet, whether time is simulated."""
        loop = asyncio.get_running_loop()
        began, timeout = loop.time(), self._master_timeout
        while True:
            try:
                self._clock.simulated = await self._parameters.get(clock.PARAMETER, default=False) is True
            except MasterUnreachableError as error:
                # One that is busy is there: other nodes of the robot start now, too.
                limit = max(timeout, BUSY_S) if timeout and error.is_late else timeout
                if limit is not None and loop.time() - began >= limit:
                    raise
                _log.info("%s; trying again", error)
                await asyncio.sleep(RETRY)
            else:
                return

    async def _leave_graph(self) -> None:
        """Unregister everything, as far as the master still answers."""
        for service in self._services.values():
            service.disconnect()
        try:
            async with asyncio.timeout(GOODBYE_TIMEOUT):
                await run_in_groups([service.close for service in self._services.values()], CLOSED_AT_ONCE)
                # First what calls the program, which may publish until then.
                inputs, outputs = self._topics.inputs.values(), self._topics.outputs.values()
                subscribers = [one for source in inputs for one in source.subscribers]
                await run_in_groups([subscriber.close for subscriber in subscribers], CLOSED_AT_ONCE)
                publishers = [one for output in outputs for one in output.publishers]
                await run_in_groups([publisher.close for publisher in publishers], CLOSED_AT_ONCE)
                await self._parameters.unwatch_all()
                await self._running.registrations.take_back_abandoned()
        except (MasterError, TimeoutError) as error:
            _log.info("%s left without telling its master: %s", self.name, str(error) or "it took too long")
        finally:
            self._topics.disconnect()
        self._running.registrations.close()
        for client in list(self._clients):
            await client.close()

    # Inside

    @property
    def _running(self) -> Runtime:
        """The running node's runtime.

        Raises:
            NodeClosedError: It is not part of the graph (yet, or any longer).
        """
        if self._runtime is None:
            raise NodeClosedError(f"node {self.name} is used outside its 'async with' block")
        return self._runtime

    @property
    def _private_parameters(self) -> dict[str, Any]:
        return {f"{self.name}/{name}": value for name, value in self._settings.parameters.items()}

    def _registrar(self, master: MasterClient) -> Registrar:
        return Registrar(
            master,
            self._topics,
            self._services,
            self._parameters,
            self.service_uri,
            self._private_parameters,
            self._stop_for_others,
        )

    def _parameter_changed(self, name: str, value: object) -> bool:
        return self._parameters.changed(name, value)

    def _accept_service(self, connection: Connection, fields: dict[str, str]) -> None:
        service = self._services.get(fields["service"])
        if service is None:
            raise HandshakeRefusedError(f"service {fields['service']} is not provided here")
        service.accept(connection, fields)
