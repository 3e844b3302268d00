"""Sets /switch on and off again."""

from rce.ros.node import Node, run


async def main() -> None:
    """Run the node."""
    async with Node("switcher", anonymous=True) as node:
        await node.wait_for_service("switch", timeout=10)
        switch = node.service_client("switch", "std_srvs/SetBool")
        for position in (True, False):
            response = await switch(data=position)
            print(response.message)


run(main())
