"""A node of a robot: says ``hello`` on one topic until a string comes on another, and prints it.

Run as a program: ``ask.py REQUESTS ANSWERS``; it needs nothing but the engine's base.
"""

from __future__ import annotations

import asyncio
import sys

from rce.ros.node import Node, run


async def ask(requests: str, answers: str) -> str:
    """Return the first answer."""
    async with Node("asker", argv=[]) as node:
        listening = await node.subscribe(answers, "std_msgs/String")
        publisher = await node.advertise(requests, "std_msgs/String")
        answer = asyncio.ensure_future(anext(aiter(listening)))
        while not answer.done():
            publisher.publish(data="hello")
            await asyncio.wait([answer], timeout=0.2)
        return str((await answer).data)


async def main() -> None:
    """Ask, and print the answer."""
    print("answer:", await ask(*sys.argv[1:]), flush=True)  # noqa: T201 - what the test reads


if __name__ == "__main__":
    run(main())
