"""Says something on /chatter ten times a second: ``python talker.py [chatter:=other_topic]``."""

from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with Node("talker") as node:
        chatter = await node.advertise("chatter", "std_msgs/String")
        count = 0
        while await node.sleep(0.1):
            chatter.publish(data=f"hello {count}")
            count += 1


run(main())
