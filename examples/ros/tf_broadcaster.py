"""A robot in a circle, with a laser in front: ``python tf_broadcaster.py [_tf_prefix:=robot1]``."""

from math import pi

from rce.ros.node import Node, run
from rce.ros.tf import StaticTransformBroadcaster, Transform, TransformBroadcaster

RADIUS = 2.0
"""Metres."""

SPEED = 0.5
"""Radians per second."""


async def main() -> None:
    """Run the node."""
    async with (
        Node("circle", anonymous=True) as node,
        StaticTransformBroadcaster(node) as fixed,
        TransformBroadcaster(node) as moving,
    ):
        fixed.send("base_link", "laser", Transform.make(x=0.3))
        while await node.sleep(0.05):
            angle = SPEED * node.time() % (2 * pi)
            # "/map" is the same frame for every robot, the others live below the prefix.
            map_from_base = Transform.make(yaw=angle) @ Transform.make(x=RADIUS, yaw=pi / 2)
            moving.send("/map", "base_link", map_from_base)


run(main())
