"""Messages of a robot's topics go to the cloud once somebody there hears them."""

from __future__ import annotations

import asyncio
from typing import Any

from rce_client.exceptions import NotConnectedError
from rce_client.ros_bridge.bridge import Uplink


class PlayedPublisher:
    """A connection with one interface, which becomes active when the test says so."""

    tag = "poseSender"

    def __init__(self) -> None:
        self.active: dict[str, bool] = {}
        self.sent: list[bytes] = []
        self.tasks: list[asyncio.Task[None]] = []
        self.closed = False
        self._changed = asyncio.Event()

    def spawn(self, work: Any) -> asyncio.Task[None]:
        self.tasks.append(asyncio.create_task(work))
        return self.tasks[-1]

    def publish(self, payload: bytes) -> bool:
        self.sent.append(payload)
        return True

    async def wait_active(self) -> None:
        await self._changed.wait()
        if self.closed:
            raise NotConnectedError("closed")

    async def change(self, *, active: bool = True, closed: bool = False) -> None:
        self.active[self.tag], self.closed = active, closed
        self._changed.set()
        await asyncio.gather(*self.tasks)
        self._changed.clear()


def uplink(played: Any) -> Uplink:
    return Uplink(played, played)


async def test_what_comes_too_early_is_not_sent_unless_it_is_latched() -> None:
    played = PlayedPublisher()
    link = uplink(played)
    link.send(b"pose 1", False)
    link.send(b"map 1", True)
    link.send(b"map 2", True)
    assert played.sent == []
    await played.change()
    assert played.sent == [b"map 2"]
    link.send(b"pose 2", False)
    link.send(b"map 3", True)
    assert played.sent == [b"map 2", b"pose 2", b"map 3"]
    assert len(played.tasks) == 1


async def test_a_latched_message_waits_again_when_the_peer_is_away() -> None:
    played = PlayedPublisher()
    link = uplink(played)
    await played.change()
    await played.change(active=False)
    link.send(b"map", True)
    assert played.sent == []
    await played.change()
    assert played.sent == [b"map"]


async def test_nothing_is_sent_over_a_connection_that_was_closed() -> None:
    played = PlayedPublisher()
    uplink(played).send(b"map", True)
    await played.change(active=False, closed=True)
    assert played.sent == []
