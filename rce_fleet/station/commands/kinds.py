"""The topics of a robot that the station uses without the planner. Pure.

A robot offers a topic by an interface whose tag is ``command_ROBOT_KEY``, such as
``command_Robot1_emergency_stop``, in its own config. The station makes the connection.

While a robot is driven by hand, a time of the station's clock goes with each velocity
(:data:`DRIVE_CLOCK`), and the robot's safety stage answers it (:data:`DRIVE_ECHO`). So the station knows the
round trip to the robot, and the stage which velocities are late.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import Any


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """A topic of a robot that the station publishes on.

    Attributes:
        key: Names the topic in the tags of interfaces.
        type_name: Type of the messages.
        topic: Its name, without namespace.
        is_latched: Whether a robot that comes later gets the last message.
        is_answer: Whether the robot publishes, and the station listens.
    """

    key: str
    type_name: str
    topic: str
    is_latched: bool = False
    is_answer: bool = False

    def interface_tag(self, robot: str) -> str:
        """Return the tag of the interface that offers this topic of a robot."""
        return f"command_{robot}_{self.key}"

    def robot_of(self, tag: str) -> str:
        """Return the robot that offers this topic by an interface with a tag; empty: none does."""
        before, after = self.interface_tag("\0").split("\0")
        is_one = tag.startswith(before) and tag.endswith(after)
        return tag[len(before) : -len(after)] if is_one else ""


EMERGENCY_STOP = RobotCommand("emergency_stop", "std_msgs/Bool", "emergency_stop", is_latched=True)
VELOCITY = RobotCommand("velocity", "geometry_msgs/Twist", "raw_cmd_vel")
INITIAL_POSE = RobotCommand("initialpose", "geometry_msgs/PoseWithCovarianceStamped", "initialpose")
DRIVE_CLOCK = RobotCommand("drive_clock", "std_msgs/Float64", "drive_clock")
DRIVE_ECHO = RobotCommand("drive_echo", "std_msgs/Float64", "drive_echo", is_answer=True)

COMMANDS = (EMERGENCY_STOP, VELOCITY, INITIAL_POSE, DRIVE_CLOCK, DRIVE_ECHO)
"""All topics that a robot offers to the station."""

POSITION_VARIANCE = 0.25
"""Variance of an initial pose in x and y, square metres, as rviz sets it."""
YAW_VARIANCE = 0.06853891945200942
"""Variance of its yaw, square radians: 15 degrees, squared."""


def stop_message(*, stopped: bool) -> dict[str, Any]:
    """Return a ``std_msgs/Bool``."""
    return {"data": stopped}


def velocity_message(speed: float, turn_rate: float) -> dict[str, Any]:
    """Return a ``geometry_msgs/Twist``; metres and radians per second."""
    return {
        "linear": {"x": speed, "y": 0.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": turn_rate},
    }


def clock_message(seconds: float) -> dict[str, Any]:
    """Return a ``std_msgs/Float64``."""
    return {"data": seconds}


def pose_message(x: float, y: float, yaw: float) -> dict[str, Any]:
    """Return a ``geometry_msgs/PoseWithCovarianceStamped`` in the map frame, as rviz publishes it.

    Args:
        x: Metres.
        y: Metres.
        yaw: Radians, counter-clockwise from x.
    """
    covariance = [0.0] * 36
    covariance[0] = covariance[7] = POSITION_VARIANCE
    covariance[35] = YAW_VARIANCE
    orientation = {"x": 0.0, "y": 0.0, "z": sin(yaw / 2), "w": cos(yaw / 2)}
    pose = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}
    return {"header": {"frame_id": "map"}, "pose": {"pose": pose, "covariance": covariance}}


LIGHT_COMMANDS = (EMERGENCY_STOP, VELOCITY)
"""Those of a light robot, which knows where it is, and is driven in the simulation's machine."""


def command_interfaces(
    robot: str, namespace: str, commands: Sequence[RobotCommand] = COMMANDS, *, prefix: str = ""
) -> Iterator[dict[str, Any]]:
    """Offer a robot's topics to the station, in the form of a client config.

    Of a topic that is not latched only the newest message waits for a slow network.

    Args:
        robot: The robot's ID in the engine.
        namespace: The robot's ID in the fleet.
        commands: The topics.
        prefix: Namespace of its topics in its ROS graph, such as ``/Robot1``.
    """
    for command in commands:
        yield {
            "eTag": robot,
            "iTag": command.interface_tag(namespace),
            "iType": "SubscriberForwarder" if command.is_answer else "PublisherForwarder",
            "iCls": command.type_name,
            "addr": f"{prefix}/{command.topic}",
            **({} if command.is_latched else {"queueSize": 1}),
        }
