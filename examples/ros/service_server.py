"""Provides /switch, which remembers what it was set to."""

from rce.ros.node import Node, run
from rce.ros.types import Message


async def main() -> None:
    """Run the node."""
    async with Node("switch") as node:
        state = False

        def switch(request: Message) -> dict[str, object]:
            nonlocal state
            before, state = state, request.data
            return {"success": True, "message": f"{before} -> {state}"}

        await node.advertise_service("switch", "std_srvs/SetBool", switch)
        await node.spin()


run(main())
