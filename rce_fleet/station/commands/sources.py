"""Ways to publish on robots' topics: through the engine, or in ROS graphs."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

from rce.ros.closing import release
from rce.ros.errors import MasterError, NodeClosedError
from rce_client.exceptions import ClientError
from rce_fleet.station.commands.kinds import EMERGENCY_STOP

if TYPE_CHECKING:
    from rce.ros.node import Node
    from rce.ros.node import Publisher as RosPublisher
    from rce_client.connection import Connection
    from rce_client.interfaces import ClientInterface
    from rce_client.topics import Publisher, Subscriber
    from rce_fleet.station.commands.kinds import RobotCommand
    from rce_fleet.station.layers.ros_source import RosLayerSource

CONNECT_S = 3.0
"""How long a robot's topic is awaited."""
POLL_S = 0.05
KEEP_S = 1.0
"""How long the master's answer is kept."""

Take = Callable[[float], None]
ReadItems = Callable[[str], Awaitable[list[dict[str, Any]]]]


class CommandError(Exception):
    """A robot cannot be reached; the text says what is missing."""


class CommandSender(ABC):
    """Publishes on one topic of one robot."""

    @abstractmethod
    def send(self, message: dict[str, Any]) -> None:
        """Publish a message in its JSON form; it never waits."""

    @property
    @abstractmethod
    def is_connected(self) -> bool:
        """Whether the robot gets messages now."""

    @abstractmethod
    async def repair(self) -> None:
        """Connect again if the robot was away: one that restarts removes its interfaces.

        Raises:
            CommandError: The robot does not offer the topic now.
        """

    @abstractmethod
    async def close(self) -> None:
        """Stop publishing."""

    async def wait_connected(self, timeout: float = CONNECT_S) -> bool:
        """Wait until the robot gets messages; return whether it does.

        Args:
            timeout: Seconds.
        """
        for _ in range(round(timeout / POLL_S)):
            if self.is_connected:
                break
            await asyncio.sleep(POLL_S)
        return self.is_connected


class CommandSource(ABC):
    """Gives senders for robots' topics."""

    @abstractmethod
    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        """Begin to publish on a topic of a robot.

        Raises:
            CommandError: The robot does not offer the topic, or engine or graph cannot be reached.
        """

    @abstractmethod
    def listen(self, robot: str, answer: RobotCommand, take: Take) -> AbstractAsyncContextManager[None]:
        """Receive the numbers that a robot answers with, while the block runs.

        Args:
            robot: Its ID.
            answer: The topic.
            take: Called with each number; must not block.

        Raises:
            CommandError: The robot does not offer the topic, or engine or graph cannot be reached.
        """

    async def robots(self) -> set[str]:
        """Return robots that offer the emergency stop, also if the planner does not know them; maybe not all.

        Raises:
            CommandError: They are not known now.
        """
        return set()


class EngineCommandSource(CommandSource):
    """Connects interfaces named ``command_ROBOT_KEY`` of robots.

    Args:
        connection: Returns the station's connection; None while there is none.
        read_items: Reads the user's items of a kind from the master.
    """

    def __init__(self, connection: Callable[[], Connection | None], read_items: ReadItems) -> None:
        self._connection = connection
        self._read_items = read_items
        self._offers: dict[str, set[str]] = {}
        """Endpoints with an interface, by its tag."""
        self._read_at = float("-inf")
        self._reading: asyncio.Task[None] | None = None

    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        """Connect the station's interface to the robot's."""
        connection = self._connected()
        tag = command.interface_tag(robot)
        endpoints = await self.find(tag, f"{robot} does not offer {command.topic}")
        try:
            publisher: Publisher[dict[str, Any]] = await connection.publisher(
                tag, command.type_name, queue_size=1
            )
        except ClientError as error:
            raise CommandError(f"the engine cannot be reached: {error}") from error
        sender = _EngineSender(self, connection, publisher, latch="1" if command.is_latched else "")
        try:
            await sender.connect(endpoints)
        except CommandError:
            await sender.close()  # a tag can be opened once only
            raise
        return sender

    @asynccontextmanager
    async def listen(self, robot: str, answer: RobotCommand, take: Take) -> AsyncIterator[None]:
        """Connect the robot's interface to the station's."""
        connection = self._connected()
        tag = answer.interface_tag(robot)
        endpoints = await self.find(tag, f"{robot} does not offer {answer.topic}")
        async with AsyncExitStack() as stack:
            try:
                subscriber: Subscriber[dict[str, Any]] = await connection.subscriber(
                    tag, answer.type_name, lambda message: take(message["data"]), queue_size=1
                )
                stack.push_async_callback(_withdraw, subscriber)
                for endpoint in endpoints:
                    await connection.connect(f"{endpoint}/{tag}", f"{connection.robot_id}/{tag}")
            except ClientError as error:
                raise CommandError(f"the engine cannot be reached: {error}") from error
            yield

    def _connected(self) -> Connection:
        connection = self._connection()
        if connection is None:
            raise CommandError("the engine is not connected")
        return connection

    async def robots(self) -> set[str]:
        """Return the robots with an interface for emergency stops."""
        offers, own = await self._read_offers(), self._own_endpoints()
        found = {EMERGENCY_STOP.robot_of(tag) for tag, endpoints in offers.items() if endpoints - own}
        return found - {""}

    async def find(self, tag: str, otherwise: str) -> set[str]:
        """Return the robots that have an interface. What the master says is kept for a second.

        Raises:
            CommandError: There is none; the text begins with ``otherwise``.
        """
        found = (await self._read_offers()).get(tag, set()) - self._own_endpoints()
        if not found:
            raise CommandError(f"{otherwise}: no interface {tag} exists")
        return found

    def _own_endpoints(self) -> set[str]:
        connection = self._connection()
        return set() if connection is None else {connection.robot_id}

    async def _read_offers(self) -> dict[str, set[str]]:
        """Return the endpoints with an interface, by its tag. All who ask meanwhile share one answer.

        With a thousand robots it has more than ten thousand interfaces: reading them for each robot takes the
        master so long that few robots are ever reached.
        """
        loop = asyncio.get_running_loop()
        if self._reading is None and loop.time() - self._read_at > KEEP_S:
            self._reading = asyncio.create_task(self._read())
            self._reading.add_done_callback(_take_note)
        if self._reading is not None:
            await asyncio.wait([reading := self._reading])
            reading.result()
        return self._offers

    async def _read(self) -> None:
        try:
            items = await self._read_items("interfaces")
        except Exception as error:
            raise CommandError(f"the engine does not say what robots offer: {error}") from error
        else:
            self._offers = {}
            for item in items:
                self._offers.setdefault(item["tag"], set()).add(str(item["endpoint"]))
            self._read_at = asyncio.get_running_loop().time()
        finally:
            self._reading = None


async def _withdraw(interface: ClientInterface) -> None:
    with suppress(ClientError):
        await interface.close()


def _take_note(reading: asyncio.Task[None]) -> None:
    """Retrieve the error of a reading: those who still wait for it raise it."""
    if not reading.cancelled():
        reading.exception()


class _EngineSender(CommandSender):
    def __init__(
        self,
        source: EngineCommandSource,
        connection: Connection,
        publisher: Publisher[dict[str, Any]],
        *,
        latch: str,
    ) -> None:
        self._source = source
        self._connection = connection
        self._publisher = publisher
        self._latch = latch

    async def connect(self, endpoints: set[str]) -> None:
        tag = self._publisher.tag
        try:
            for endpoint in endpoints:
                await self._connection.connect(f"{self._connection.robot_id}/{tag}", f"{endpoint}/{tag}")
        except ClientError as error:
            raise CommandError(f"the engine cannot be reached: {error}") from error

    async def repair(self) -> None:
        if not self.is_connected:
            await self.connect(await self._source.find(self._publisher.tag, "the robot is away"))

    def send(self, message: dict[str, Any]) -> None:
        self._publisher.publish(message, latch=self._latch)

    @property
    def is_connected(self) -> bool:
        return self._connection.is_active(self._publisher.tag)

    async def close(self) -> None:
        await _withdraw(self._publisher)


class RosCommandSource(CommandSource):
    """Publishes in the planner's graph, or in the robot's own if discovery knows one.

    Args:
        graphs: Joins robots' graphs.
    """

    def __init__(self, graphs: RosLayerSource) -> None:
        self._graphs = graphs

    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        """Advertise the topic in the robot's graph."""
        sender = _RosSender(self._graphs, robot, command)
        await sender.join()
        return sender

    @asynccontextmanager
    async def listen(self, robot: str, answer: RobotCommand, take: Take) -> AsyncIterator[None]:
        """Subscribe to the topic in the robot's graph."""
        async with AsyncExitStack() as stack:
            try:
                node, namespace = await stack.enter_async_context(self._graphs.graph_of(robot))
                subscriber = await node.subscribe(
                    f"{namespace}{answer.topic}", answer.type_name, lambda message: take(message.data)
                )
            except Exception as error:
                raise CommandError(f"the ROS graph of {robot} cannot be reached: {error}") from error
            stack.push_async_callback(release, subscriber)
            yield

    async def robots(self) -> set[str]:
        """Return the robots of the planner's graph that subscribe to emergency stops."""
        try:
            return await self._graphs.find_subscribed(EMERGENCY_STOP.topic)
        except MasterError as error:
            raise CommandError(f"the ROS master does not say which robots there are: {error}") from error


class _RosSender(CommandSender):
    def __init__(self, graphs: RosLayerSource, robot: str, command: RobotCommand) -> None:
        self._graphs = graphs
        self._robot = robot
        self._command = command
        self._stack = AsyncExitStack()
        self._node: Node | None = None
        self._publisher: RosPublisher | None = None
        self._last: dict[str, Any] | None = None

    async def join(self) -> None:
        """Advertise the topic in the graph where the robot is now, unless it is done already."""
        command = self._command
        async with AsyncExitStack() as stack:
            try:
                node, namespace = await stack.enter_async_context(self._graphs.graph_of(self._robot))
                if node is self._node:
                    return
                publisher = await node.advertise(
                    f"{namespace}{command.topic}", command.type_name, latch=command.is_latched, queue_size=1
                )
            except Exception as error:
                raise CommandError(f"the ROS graph of {self._robot} cannot be reached: {error}") from error
            stack.push_async_callback(release, publisher)
            before, self._stack = self._stack, stack.pop_all()
            self._node, self._publisher = node, publisher
            if self._last is not None and command.is_latched:
                self.send(self._last)
            await before.aclose()

    def send(self, message: dict[str, Any]) -> None:
        self._last = message
        if self._publisher is not None:
            with suppress(NodeClosedError):  # it was told to stop: the robot is not connected then
                self._publisher.publish(message)

    @property
    def is_connected(self) -> bool:
        return self._publisher is not None and self._publisher.connections > 0

    async def repair(self) -> None:
        """Move to the robot's own graph, which discovery may not have known before, or know elsewhere now.

        In the same graph subscribers find the topic by themselves.
        """
        if not self.is_connected:
            await self._graphs.look_again()
            await self.join()

    async def close(self) -> None:
        await self._stack.aclose()
