"""How the station finds the robots' interfaces for commands."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, cast

import pytest

from rce_client.sendqueue import QueuedMessage, QueueLimits, SendQueue
from rce_client.topics import Publisher
from rce_fleet.station.commands.kinds import RobotCommand, velocity_message
from rce_fleet.station.commands.sources import CommandError, EngineCommandSource

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.protocol import Frame
    from rce_client.interfaces import InterfaceOwner

TAGS = [f"command_Robot{number}_emergency_stop" for number in range(50)]


class Items:
    """Gives the interfaces of fifty robots when it is let, and counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.may_answer = asyncio.Event()
        self.error: Exception | None = None

    async def read(self, kind: str) -> list[dict[str, Any]]:
        assert kind == "interfaces"
        self.asked += 1
        await self.may_answer.wait()
        if self.error is not None:
            raise self.error
        return [{"tag": tag, "endpoint": "robots"} for tag in TAGS]


async def test_all_who_ask_meanwhile_share_one_answer() -> None:
    items = Items()
    source = EngineCommandSource(lambda: None, items.read)
    asking = [asyncio.create_task(source.find(tag, "none")) for tag in TAGS]
    given_up = asyncio.create_task(source.find(TAGS[0], "none"))
    await asyncio.sleep(0)
    given_up.cancel()
    items.may_answer.set()
    assert await asyncio.gather(*asking) == [{"robots"}] * len(TAGS)
    assert await source.find(TAGS[0], "none") == {"robots"}
    assert items.asked == 1


async def test_a_failed_answer_is_asked_for_again() -> None:
    items = Items()
    items.may_answer.set()
    items.error = OSError("the master is away")
    source = EngineCommandSource(lambda: None, items.read)
    asking = [asyncio.create_task(source.find(tag, "none")) for tag in TAGS[:2]]
    for task in asking:
        with pytest.raises(CommandError, match="the master is away"):
            await task
    items.error = None
    assert await source.find(TAGS[0], "none") == {"robots"}
    assert items.asked == 2


class Connection:
    """Makes publishers whose messages wait, because the network is slow."""

    robot_id = "station"
    takes_single_frames = False

    def __init__(self) -> None:
        self.queue = SendQueue(QueueLimits())

    async def publisher(self, tag: str, message_type: str, *, queue_size: int | None) -> Publisher[Any]:
        return Publisher(cast("InterfaceOwner", self), tag, message_type, raw=False, queue_size=queue_size)

    async def connect(self, first: str, second: str) -> None:
        """Do nothing."""

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        self.queue.put_data(tag, QueuedMessage.of(frames, key), queue_size)
        return True


async def test_only_the_newest_velocity_waits_for_the_network() -> None:
    items, connection = Items(), Connection()
    items.may_answer.set()
    source = EngineCommandSource(lambda: cast("Any", connection), items.read)
    sender = await source.open("Robot1", RobotCommand("emergency_stop", "geometry_msgs/Twist", "cmd_vel"))
    for speed in (0.3, 0.2, 0.0):
        sender.send(velocity_message(speed, 0.0))
    waiting = connection.queue.pop()
    assert waiting is not None
    assert json.loads(waiting.frames[0])["data"]["msg"]["linear"]["x"] == 0.0
    assert not connection.queue
