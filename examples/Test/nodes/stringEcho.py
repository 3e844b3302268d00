#!/usr/bin/env python3
"""Gives every string back: by topic (the last answer stays for late subscribers) and by service."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.ros.node import Node, run

if TYPE_CHECKING:
    from rce.ros.types import Message


async def main() -> None:
    """Echo until the node is told to stop."""
    async with Node("stringEcho") as node:
        responses = await node.advertise("stringEchoResp", "std_msgs/String", latch=True)

        def echo(request: Message) -> dict[str, str]:
            return {"data": request.data}

        await node.advertise_service("stringEchoService", "Test/StringEcho", echo)
        await node.subscribe("stringEchoReq", "std_msgs/String", responses.publish)
        await node.spin()


if __name__ == "__main__":
    run(main())
