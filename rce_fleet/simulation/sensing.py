"""What robots' range sensors measure in a world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.simulation.lidar import Floats, cast_many, measure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.simulation.robot import SimulatedRobot
    from rce_fleet.simulation.solids import Solids


def scan_all(
    robots: Sequence[SimulatedRobot], solids: Solids, circles: Floats, step: int
) -> dict[str, Floats]:
    """Return the scans of robots, those with the same sensor computed together.

    Args:
        robots: The robots that scan.
        solids: Walls, boxes and doors.
        circles: Robots and walkers, shape (C, 3): x, y and radius, metres. No robot sees itself.
        step: Number of the world's step, for the noise.

    Returns:
        For each robot's id, shape (beams,), metres; see :func:`rce_fleet.simulation.lidar.measure`.
    """
    opaque, glass = solids.edges(glass=False), solids.edges(glass=True)
    made: dict[str, Floats] = {}
    for spec in {robot.model.lidar for robot in robots}:
        group = [robot for robot in robots if robot.model.lidar == spec]
        poses = spec.poses(np.array([robot.place for robot in group]))
        behind = cast_many(spec, poses, opaque, circles)
        exact = behind
        if len(glass):
            exact = np.minimum(behind, cast_many(spec, poses, glass, np.empty((0, 3))))
        for index, robot in enumerate(group):
            rng = robot.scan_rng(step)
            made[robot.id] = measure(spec, exact[index], rng, behind[index] if len(glass) else None)
    return made
