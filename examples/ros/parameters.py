"""Reads and writes parameters: ``python parameters.py [_gain:=2.5]``."""

from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with Node("tuner", anonymous=True) as node:
        gain = await node.get_param("~gain", 1.0)
        await node.set_param("/control", {"gain": gain, "axes": ["x", "y"]})
        print("control:", await node.get_param("/control"))
        print("has /control/axes:", await node.has_param("/control/axes"))
        await node.delete_param("/control/axes")
        print("names:", [name for name in await node.get_param_names() if name.startswith("/control")])


run(main())
