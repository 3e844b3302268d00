"""The programs of a robot that others may reach: ``robot_base NUMBER``.

It publishes ``/RobotN/scan`` and ``/RobotN/odom``, obeys ``/RobotN/cmd_vel``, provides ``/RobotN/enable`` and
has the parameter ``/RobotN/max_speed``. It tells when it was moved, called, or ended through its graph.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from .core_api import CoreApi
from .graph import Stamp, open_graph
from .telling import tell

SCAN, ODOMETRY, TWIST, TRIGGER = (
    "sensor_msgs/LaserScan",
    "nav_msgs/Odometry",
    "geometry_msgs/Twist",
    "std_srvs/Trigger",
)
PERIOD_S = 0.2
MOVED, CALLED, ENDED = "moved", "called", "ended"


class RobotBase:
    """Tells once what others did to it."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def move(self, _message: Any) -> None:
        """Take a velocity."""
        self._tell(MOVED)

    def enable(self) -> dict[str, Any]:
        """Answer a call."""
        self._tell(CALLED)
        return {"success": True}

    def _tell(self, what: str) -> None:
        if what not in self._told:
            self._told.add(what)
            tell({what: True})


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="robot_base", description=__doc__)
    parser.add_argument("number", type=int)
    options = parser.parse_args()
    name = f"Robot{options.number}"
    graph = open_graph(f"{name}_base")
    CoreApi(f"/{name}_base").set_parameter(f"/{name}/max_speed", 0.5)
    base = RobotBase()
    outputs = [graph.output(f"/{name}/scan", SCAN), graph.output(f"/{name}/odom", ODOMETRY)]
    graph.take(f"/{name}/cmd_vel", TWIST, base.move)
    graph.provide(f"/{name}/enable", TRIGGER, base.enable)

    def step() -> float:
        for output in outputs:
            output.send({}, Stamp(time.time_ns(), name))
        return PERIOD_S

    graph.run(step)
    tell({ENDED: True})


if __name__ == "__main__":
    main()
