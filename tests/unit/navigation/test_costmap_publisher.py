"""What is published of a costmap, with a node that only notes it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rce.ros.types import Time, TypeRegistry
from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import Area
from rce_fleet.navigation.costmap.costs import LETHAL
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.parameters import CostmapParameters
from rce_fleet.nodes.costmap_publisher import CostmapPublisher

HERE = Pose(1.0, 1.0, 0.0)


class NotingPublisher:
    """Notes the fields of messages that a subscriber would get."""

    connections = 1

    def __init__(self, kind: str) -> None:
        self.type = TypeRegistry().message(kind)
        self.sent: list[dict[str, Any]] = []

    def publish(self, **fields: Any) -> None:
        self.type.serialize(self.type.new(**fields))
        self.sent.append(fields)


class NotingNode:
    """Stands for a node."""

    def __init__(self) -> None:
        self.seconds = 100.0
        self.published: dict[str, NotingPublisher] = {}

    def time(self) -> float:
        return self.seconds

    def now(self) -> Time:
        return Time.from_sec(self.seconds)

    async def advertise(self, topic: str, kind: str, **_options: Any) -> NotingPublisher:
        return self.published.setdefault(topic, NotingPublisher(kind))


async def test_costs_are_published_as_arrays_not_lists() -> None:
    """A list of a million numbers would hold up the control step for a quarter of a second."""
    node = NotingNode()
    parameters = CostmapParameters(publish_frequency=5.0, width=2.0, height=3.0, resolution=0.1)
    costmap = LayeredCostmap(parameters, Footprint(0.2))
    publisher = CostmapPublisher(node, "map", costmap)  # type: ignore[arg-type] # it stands for one
    await publisher.start()
    publisher.publish(HERE, "map")
    costmap.grid.values[4:6, 7] = LETHAL
    publisher.note(Area(4, 7, 6, 8))
    node.seconds += 1.0
    publisher.publish(HERE, "map")
    (whole,) = node.published["~map/costmap"].sent
    (update,) = node.published["~map/costmap_updates"].sent
    for data, expected in ((whole["data"], [0] * 600), (update["data"], [100, 100])):
        assert isinstance(data, np.ndarray)
        assert data.tolist() == expected
