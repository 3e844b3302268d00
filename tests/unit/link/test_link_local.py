"""Links within a process: how much is delivered in a step of the event loop."""

from __future__ import annotations

import asyncio

from rce.link.carrier import Carrier, LocalCarrier
from rce.link.frames import Frame, FrameType


class Handler:
    """Notes what comes."""

    def __init__(self) -> None:
        self.got: list[Frame] = []

    def frame_received(self, frame: Frame) -> None:
        self.got.append(frame)

    def grew(self) -> None:
        pass

    def carrier_lost(self, carrier: Carrier, reason: Exception) -> None:
        raise reason


async def deliveries(frames: list[Frame]) -> list[int]:
    """Return how many frames come in each step until all have come, in order."""
    one, other = LocalCarrier.pair()
    handler = Handler()
    other.start(handler)
    for frame in frames:
        one.control(frame)
    counts = []
    while len(handler.got) < len(frames):
        before = len(handler.got)
        await asyncio.sleep(0)
        counts.append(len(handler.got) - before)
    assert handler.got == frames
    one.close()
    return counts


async def test_large_messages_come_in_a_step_each() -> None:
    frames = [Frame(FrameType.DATA, number, payload=bytes(3 << 20)) for number in range(3)]
    assert await deliveries(frames) == [1, 1, 1]


async def test_small_messages_come_together() -> None:
    frames = [Frame(FrameType.DATA, number, payload=bytes(100)) for number in range(50)]
    assert await deliveries(frames) == [50]


async def test_a_step_ends_with_the_first_message_over_its_share() -> None:
    frames = [Frame(FrameType.DATA, number, payload=bytes(400 << 10)) for number in range(5)]
    assert await deliveries(frames) == [3, 2]
