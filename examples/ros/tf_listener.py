"""Prints where the laser is: ``python tf_listener.py [_tf_prefix:=robot1]``."""

from rce.ros.node import Node, run
from rce.ros.tf import TransformListener


async def main() -> None:
    """Run the node."""
    async with Node("where", anonymous=True) as node, TransformListener(node) as tf:
        await tf.wait_for("/map", "laser", timeout=30)
        while await node.sleep(0.2):
            found = tf.lookup("/map", "laser")
            x, y, _ = found.transform.translation
            print(f"{found.child} at x={x:.2f} m, y={y:.2f} m, yaw={found.transform.yaw:.2f} rad", flush=True)


run(main())
