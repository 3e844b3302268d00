"""The core as a server: XML-RPC in, the graph in the middle, calls to nodes and events to watchers out."""

from __future__ import annotations

import asyncio
import copy
import uuid
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rce.aio.tasks import TaskScope
from rce.ros.core.api import NOTHING, MasterApi, roslaunch_methods
from rce.ros.core.events import Call, GraphEvent, Outcome
from rce.ros.core.graph import Graph
from rce.ros.core.notifier import Notifier
from rce.ros.errors import ParameterMissingError
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer

DEFAULT_PORT = 11311

ROS_DISTRIBUTION = "noetic"
ROS_VERSION = "1.15.15"
"""The release of ROS whose behaviour this core follows; tools read it as ``/rosversion``."""

MAX_WAITING_EVENTS = 10_000


class GraphWatch:
    """Events of the graph since the watch began, in order; an async iterator that never ends."""

    def __init__(self) -> None:
        self.lost = 0
        """How many events were dropped, the oldest first, because they were not taken."""
        self._events: deque[GraphEvent] = deque()
        self._arrived = asyncio.Event()

    def put(self, event: GraphEvent) -> None:
        """Add an event."""
        if len(self._events) >= MAX_WAITING_EVENTS:
            self._events.popleft()
            self.lost += 1
        self._events.append(event)
        self._arrived.set()

    def __aiter__(self) -> AsyncIterator[GraphEvent]:
        return self

    async def __anext__(self) -> GraphEvent:
        while not self._events:
            self._arrived.clear()
            await self._arrived.wait()
        return self._events.popleft()


class Core:
    """A ROS master with its parameter server. An async context manager, serving inside its block.

    Unmodified ROS nodes and tools find it by ``ROS_MASTER_URI``. The process that hosts it may read
    :attr:`graph`, watch it, and tell it of nodes that died.

    Attributes:
        graph: The state. Read only: changes go through the methods of this class or through XML-RPC.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        *,
        advertised: str | None = None,
        rosout: bool = False,
        log_folder: Path | None = None,
        on_shutdown: Callable[[str], None] | None = None,
    ) -> None:
        """Prepare a core.

        Args:
            host: Address to listen on; ``0.0.0.0`` for all.
            port: 0 takes a free one.
            advertised: Host or address in :attr:`uri`; by default ``host``, or loopback if that is "all".
            rosout: Run the node ``/rosout``, which gathers all nodes' log records on ``/rosout_agg``.
            log_folder: With ``rosout``: where to keep ``RUN_ID/rosout.log``; ``None``: nowhere.
            on_shutdown: Takes the reason when a caller tells the core to end; without it, that is refused.
        """
        self.graph = Graph()
        self._local = "127.0.0.1" if host == "0.0.0.0" else host  # noqa: S104
        self._advertised = advertised or self._local
        self._rosout = rosout
        self._run_id = str(uuid.uuid1())
        self._log_folder = log_folder / self._run_id if log_folder is not None else None
        self._api = MasterApi(self.graph, lambda: self.uri, self._perform, on_shutdown)
        methods = self._api.methods() | roslaunch_methods()
        self._server = RpcServer(Dispatcher(methods, NOTHING), host, port)
        self._notifier: Notifier | None = None
        self._watches: set[GraphWatch] = set()
        self._changed = asyncio.Event()
        self._stack = AsyncExitStack()

    @property
    def uri(self) -> str:
        """The value for ``ROS_MASTER_URI``."""
        return f"http://{self._advertised}:{self._server.port}/"

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            client = await stack.enter_async_context(RpcClient())
            tasks = await stack.enter_async_context(TaskScope())
            self._notifier = Notifier(client, tasks, self._unwanted)
            await stack.enter_async_context(self._server)
            self._set_well_known_parameters()
            if self._rosout:
                await stack.enter_async_context(self._gathering_logs())
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()
        self._notifier = None

    # For the hosting process

    @contextmanager
    def watch(self) -> Iterator[GraphWatch]:
        """Watch the graph: ``with core.watch() as events: async for event in events: ...``."""
        watch = GraphWatch()
        self._watches.add(watch)
        try:
            yield watch
        finally:
            self._watches.discard(watch)

    async def wait_until(self, condition: Callable[[Graph], bool], *, timeout: float | None = None) -> None:
        """Wait until the graph fulfils ``condition``, which is asked again after every change.

        Args:
            condition: For instance ``lambda graph: "/talker" in graph.nodes``.
            timeout: Seconds.

        Raises:
            TimeoutError: The condition was not met in time.
        """
        async with asyncio.timeout(timeout):
            while not condition(self.graph):
                self._changed.clear()
                await self._changed.wait()

    def forget_node(self, name: str) -> bool:
        """Unregister everything of a node that died; return whether anything was registered."""
        known = self.graph.node(name) is not None
        self._perform(self.graph.forget_node(name))
        return known

    def set_param(self, name: str, value: Any) -> None:
        """Set a parameter or namespace by its global name."""
        self._perform(self.graph.set_parameter(name, value))

    def get_param(self, name: str) -> Any:
        """Return a parameter or namespace by its global name.

        Raises:
            ParameterMissingError: It is not set.
        """
        try:
            return copy.deepcopy(self.graph.parameters.get(name))
        except KeyError as error:
            raise ParameterMissingError(name) from error

    def delete_param(self, name: str) -> bool:
        """Delete a parameter or namespace by its global name; return whether it was set."""
        try:
            self._perform(self.graph.delete_parameter(name))
        except KeyError:
            return False
        return True

    # Inside

    @asynccontextmanager
    async def _gathering_logs(self) -> AsyncIterator[None]:
        from rce.ros.core.rosout import RosoutNode  # a core without rosout needs no node

        uri = f"http://{self._local}:{self._server.port}/"
        async with RosoutNode(uri, self._advertised, self._log_folder) as node:
            await node.gather()
            yield

    def _perform(self, outcome: Outcome) -> None:
        if self._notifier is not None:
            for call in outcome.calls:
                self._notifier.submit(call)
        for event in outcome.events:
            for watch in self._watches:
                watch.put(event)
        self._changed.set()

    def _unwanted(self, call: Call) -> None:
        if call.method == "paramUpdate":
            self._perform(self.graph.drop_parameter_subscription(call.uri, call.arguments[0]))

    def _set_well_known_parameters(self) -> None:
        self.set_param("/run_id", self._run_id)
        self.set_param("/rosversion", f"{ROS_VERSION}\n")
        self.set_param("/rosdistro", f"{ROS_DISTRIBUTION}\n")
        host = "".join(character if character.isalnum() else "_" for character in self._advertised)
        self.set_param(f"/roslaunch/uris/host_{host}__{self._server.port}", self.uri)
