"""Prints what is said on /chatter: ``python listener.py [chatter:=other_topic]``."""

from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with Node("listener") as node:
        async for message in await node.subscribe("chatter", "std_msgs/String"):
            print(message.data, flush=True)


run(main())
