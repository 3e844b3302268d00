"""Asks /fibonacci for a sequence and cancels another one: ``python fibonacci_client.py [_order:=8]``."""

from rce.ros.actions import ActionClient, GoalFailedError
from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with (
        Node("fibonacci_client", anonymous=True) as node,
        ActionClient(node, "fibonacci", "actionlib_tutorials/FibonacciAction") as client,
    ):
        goal = await client.send(order=await node.get_param("~order", 8))
        async for feedback in goal:
            print("so far:", *feedback.sequence, flush=True)
        result = await goal.result()
        print("result:", *result.sequence)

        endless = await client.send(order=1_000_000)
        await anext(aiter(endless))
        endless.cancel()
        try:
            await endless.result(timeout=10)
        except GoalFailedError as error:
            print("ended:", error.state.name.lower())


run(main())
