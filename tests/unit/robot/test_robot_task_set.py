"""The robot task set, with a channel and sessions that live in the test: in which order things reach it."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, cast

import pytest
from support.absent_masters import FailingChannel

from rce.control.exceptions import MasterUnavailableError
from rce.control.messages import Drop, Gone, Left, MachineInfo, Put, Sync, ToMaster
from rce.control.model import EndpointKind, EndpointSpec, LinkAddress
from rce.guard import Lobby
from rce.link import Endpoint, LinkHub
from rce.model.names import EndpointId
from rce.protocol import HandshakeError
from rce.ros.types import TypeRegistry
from rce_robot.factory import FormFactory
from rce_robot.settings import RobotSettings
from rce_robot.taskset import RobotTaskSet

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce_robot.conversion import ConversionPool
    from rce_robot.doors.base import DoorSession

ID = EndpointId("anna", "rob")


class Channel(FailingChannel):
    """Keeps what the task set sends."""

    def __init__(self) -> None:
        super().__init__(MasterUnavailableError(0.0))
        self.sent: list[ToMaster] = []

    def send(self, message: ToMaster) -> None:
        self.sent.append(message)

    def ends(self) -> list[Left | Gone]:
        """Return what was told of robots' ends."""
        return [message for message in self.sent if isinstance(message, (Left, Gone))]


class Connected:
    """A session that ends as soon as it is closed."""

    client = "a test"
    held = 0

    def __init__(self) -> None:
        self.closed = ""

    async def close(self, reason: str, *, elsewhere: bool = False, finishes: bool = False) -> None:
        self.closed = reason


@asynccontextmanager
async def running() -> AsyncIterator[tuple[RobotTaskSet, Channel]]:
    task_set = RobotTaskSet(
        LinkHub("here"),
        FormFactory(TypeRegistry()),
        RobotSettings(usage_interval=60.0),
        name="r1",
        machine=MachineInfo(name="here"),
        url="ws://here/",
        address=LinkAddress(machine="here"),
        lobby=Lobby("robots", per_address=1, in_all=1),
        pool=cast("ConversionPool", None),
    )
    channel = Channel()
    task_set.use(channel)
    task_set.hello()
    runner = asyncio.create_task(task_set.run())
    await asyncio.sleep(0)
    try:
        yield task_set, channel
    finally:
        runner.cancel()
        await asyncio.wait([runner])


def spec(revision: int) -> EndpointSpec:
    return EndpointSpec(id=str(ID), kind=EndpointKind.ROBOT, revision=revision)


async def connect(task_set: RobotTaskSet, revision: int) -> Connected:
    namespace = await task_set.settle(spec(revision))
    session = Connected()
    namespace.session = cast("DoorSession", session)
    return session


async def test_drop_from_before_the_login_is_ignored() -> None:
    """The answer to a login overtakes messages that wait for the one that is being handled."""
    async with running() as (task_set, channel):
        await task_set.handle(Put(endpoint=spec(5)))
        session = await connect(task_set, 12)
        await task_set.handle(Drop(id=str(ID), revision=10, reason="sent away"))
        namespace = task_set.find(ID)
        assert namespace is not None
        assert channel.ends() == []
        await task_set.handle(Drop(id=str(ID), revision=13, reason="sent away again"))
        assert task_set.find(ID) is None
        await task_set.settle(spec(14))
        assert session.closed == "sent away again"
        assert [type(message) for message in channel.ends()] == [Left, Gone]


async def test_drop_holds_after_a_login_on_a_former_channel() -> None:
    """Another master may count revisions from a smaller number."""
    async with running() as (task_set, _):
        await connect(task_set, 1000)
        task_set.hello()
        await task_set.handle(Sync(endpoints=(spec(2),)))
        await task_set.handle(Drop(id=str(ID), revision=3, reason="sent away"))
        assert task_set.find(ID) is None


async def test_sync_leaves_robots_that_logged_in_after_hello() -> None:
    async with running() as (task_set, _):
        await connect(task_set, 12)
        await task_set.handle(Sync(endpoints=()))
        assert task_set.find(ID) is not None
        task_set.hello()
        await task_set.handle(Sync(endpoints=()))
        assert task_set.find(ID) is None


async def test_drop_of_former_session_reports_that_it_left() -> None:
    """The master may have let the robot in again, and the gate refused it because of this session."""
    async with running() as (task_set, channel):
        former = await connect(task_set, 8)
        await task_set.settle(spec(12))
        await task_set.handle(Drop(id=str(ID), revision=10, reason="sent away"))
        assert task_set.find(ID) is None
        assert channel.ends()[:1] == [Left(id=str(ID), reason="sent away")]
        await task_set.settle(spec(14))
        assert former.closed == "sent away"


async def test_robot_dropped_while_its_spec_is_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its session would be put on an endpoint that is being closed."""
    reached, released = asyncio.Event(), asyncio.Event()
    apply = Endpoint.apply

    async def apply_late(self: Endpoint, desired: EndpointSpec) -> None:
        reached.set()
        await released.wait()
        await apply(self, desired)

    monkeypatch.setattr(Endpoint, "apply", apply_late)
    async with running() as (task_set, _):
        settling = asyncio.create_task(task_set.settle(spec(12)))
        await reached.wait()
        await task_set.handle(Drop(id=str(ID), revision=13, reason="sent away"))
        released.set()
        with pytest.raises(HandshakeError, match="sent away while it logged in") as caught:
            await settling
        assert caught.value.status == 503
        assert task_set.find(ID) is None
