"""Transforms between the frames of robots over time: ROS's tf.

::

    async with TransformListener(node) as tf:
        map_from_base = await tf.wait_for("map", "base_link", timeout=1.0)
        print(map_from_base.transform.apply((1.0, 0.0, 0.0)))
"""

from rce.ros.tf.broadcaster import StaticTransformBroadcaster, TransformBroadcaster, find_prefix
from rce.ros.tf.buffer import Buffer
from rce.ros.tf.exceptions import (
    BadTransformError,
    ConnectivityError,
    ExtrapolationError,
    FrameLoopError,
    TransformError,
    TransformTimeoutError,
    UnknownFrameError,
)
from rce.ros.tf.frames import resolve
from rce.ros.tf.listener import TransformListener
from rce.ros.tf.stamped import StampedTransform
from rce.ros.tf.transform import Quaternion, Transform, Vector

__all__ = [
    "BadTransformError",
    "Buffer",
    "ConnectivityError",
    "ExtrapolationError",
    "FrameLoopError",
    "Quaternion",
    "StampedTransform",
    "StaticTransformBroadcaster",
    "Transform",
    "TransformBroadcaster",
    "TransformError",
    "TransformListener",
    "TransformTimeoutError",
    "UnknownFrameError",
    "Vector",
    "find_prefix",
    "resolve",
]
