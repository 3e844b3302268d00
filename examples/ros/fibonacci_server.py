"""Provides the action /fibonacci, one goal at a time: ``python fibonacci_server.py [_period:=0.5]``."""

from __future__ import annotations

from rce.ros.actions import ServerGoal, SimpleActionServer
from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with Node("fibonacci") as node:
        period = await node.get_param("~period", 0.1)

        async def compute(goal: ServerGoal) -> dict[str, object] | None:
            sequence = [0, 1]
            while len(sequence) <= goal.request.order:
                if not await goal.sleep(period):
                    return None  # asked to end: the goal is preempted
                sequence.append(sequence[-1] + sequence[-2])
                goal.publish_feedback(sequence=sequence)
            return {"sequence": sequence}

        async with SimpleActionServer(node, "fibonacci", "actionlib_tutorials/FibonacciAction", compute):
            await node.spin()


run(main())
