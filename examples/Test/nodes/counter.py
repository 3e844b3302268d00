#!/usr/bin/env python3
"""Counts, five times a second, on ``count`` (std_msgs/UInt64); its count is saved and restored on request.

A container that keeps its state names the services: ``state: {save: save_count, restore: restore_count}``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node, run

if TYPE_CHECKING:
    from rce.ros.types import Message

PERIOD_S = 0.2


async def main() -> None:
    """Count until the node is told to stop."""
    async with Node("counter") as node:
        counts = await node.advertise("count", "std_msgs/UInt64", latch=True)
        count = 0

        def save(_: Message) -> dict[str, bytes]:
            return {"data": str(count).encode()}

        def restore(request: Message) -> dict[str, object]:
            nonlocal count
            text = bytes(request.data)
            if not text.isdigit():
                raise ServiceFaultError("restore_count", f"{text[:40]!r} is not a count")
            count = int(text)
            node.log.info("goes on from %d", count)
            return {}

        await node.advertise_service("save_count", "rce_msgs/SaveState", save)
        await node.advertise_service("restore_count", "rce_msgs/RestoreState", restore)
        while await node.sleep(PERIOD_S):
            count += 1
            counts.publish(data=count)


if __name__ == "__main__":
    run(main())
