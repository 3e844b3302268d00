"""A robot's outline seen from above: its radii, and its exact distance to obstacles along a trajectory."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_ROUND_CORNERS = 16
"""Corners of the polygon that is published for a round robot, as in costmap_2d."""
_MIN_CORNERS = 3


@dataclass(frozen=True)
class Footprint:
    """A disc around the robot's centre, or a simple polygon that contains the centre.

    Attributes:
        radius: Radius of the disc, metres; 0 for a polygon.
        corners: Corners of the polygon, ``(x, y)`` in the robot's frame, metres; empty for a disc.

    Raises:
        ValueError: It is neither a disc nor a polygon, or the polygon does not contain the robot's centre.
    """

    radius: float = 0.0
    corners: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.corners:
            if len(self.corners) < _MIN_CORNERS or not np.isfinite(self.corners).all():
                raise ValueError(f"footprint: expected at least 3 finite corners, found {self.corners}")
            if not self._inside(np.zeros((1, 2)))[0]:
                raise ValueError("footprint: expected a polygon around the robot's centre (0, 0)")
        elif not 0 < self.radius < np.inf:
            raise ValueError(f"robot_radius: expected metres above 0, found {self.radius}")

    @classmethod
    def read(cls, footprint: Any, robot_radius: float, padding: float = 0.0) -> Footprint:
        """Return the footprint that costmap_2d's parameters describe.

        Args:
            footprint: List of corners ``[[x, y], ...]``, or the same as text; empty or None: a disc.
            robot_radius: Radius of the disc, metres.
            padding: Metres by which it is made larger (``footprint_padding``).

        Raises:
            ValueError: The parameters describe no footprint.
        """
        if isinstance(footprint, str):
            try:
                footprint = json.loads(footprint or "[]")
            except ValueError as error:
                raise ValueError(f"footprint: expected [[x, y], ...], found {footprint!r}") from error
        if not footprint:
            return cls(float(robot_radius) + padding)
        try:
            corners = [(float(x), float(y)) for x, y in footprint]
        except (TypeError, ValueError) as error:
            raise ValueError(f"footprint: expected [[x, y], ...], found {footprint!r}") from error
        if len(corners) < _MIN_CORNERS:
            return cls(float(robot_radius) + padding)
        return cls(corners=tuple(_padded(corners, padding)))

    @property
    def is_round(self) -> bool:
        """Whether it is a disc."""
        return not self.corners

    @cached_property
    def polygon(self) -> Floats:
        """Its corners, shape (N, 2); 16 of them for a disc, to publish and to draw."""
        if self.corners:
            return np.array(self.corners, np.float64)
        angles = np.arange(_ROUND_CORNERS) * 2 * pi / _ROUND_CORNERS
        return np.stack((np.cos(angles), np.sin(angles)), axis=1) * self.radius

    @cached_property
    def inscribed_radius(self) -> float:
        """Radius of the largest circle around the centre inside, metres."""
        return self.radius if self.is_round else float(self._edge_distance(np.zeros((1, 2)))[0])

    @cached_property
    def circumscribed_radius(self) -> float:
        """Radius of the smallest circle around the centre that contains it, metres."""
        return self.radius if self.is_round else float(np.hypot(*self.polygon.T).max())

    def at(self, x: float, y: float, yaw: float) -> Floats:
        """Return the corners of the polygon for a pose of the robot, shape (N, 2), metres."""
        turn = np.array(((cos(yaw), sin(yaw)), (-sin(yaw), cos(yaw))))
        return np.asarray(self.polygon @ turn + (x, y))

    def distances(self, points: Floats) -> Floats:
        """Return the distance of points from the outline, shape (M,), metres; negative inside.

        Args:
            points: Shape (M, 2), metres in the robot's frame.
        """
        if self.is_round:
            return np.asarray(np.hypot(points[:, 0], points[:, 1]) - self.radius)
        return np.where(self._inside(points), -1.0, 1.0) * self._edge_distance(points)

    def clearance(self, poses: Floats, points: Floats, *, enough: float = 0.5) -> Floats:
        """Return the distance from the outline to the nearest obstacle for each pose, shape (T,), metres.

        Args:
            poses: Shape (T, 3): x, y, yaw.
            points: Obstacles, shape (M, 2), metres in the frame of the poses.
            enough: Distances above this need not be exact: never more than the true distance is returned.

        Returns:
            Negative if an obstacle is inside the outline, ``inf`` without obstacles.
        """
        if not len(points) or not len(poses):
            return np.full(len(poses), np.inf)
        dx = points[None, :, 0] - poses[:, None, 0]
        dy = points[None, :, 1] - poses[:, None, 1]
        squared = dx * dx + dy * dy
        if self.is_round:
            return np.asarray(np.sqrt(squared.min(axis=1)) - self.radius)
        reach = self.circumscribed_radius
        nearest = np.sqrt(squared.min(axis=1)) - reach
        pose, point = np.nonzero(squared <= (reach + enough) ** 2)
        c, s = np.cos(poses[pose, 2]), np.sin(poses[pose, 2])
        px, py = dx[pose, point], dy[pose, point]
        local = np.stack((c * px + s * py, c * py - s * px), axis=1)
        signed = self.distances(local)
        exact = np.full(len(poses), np.inf)
        np.minimum.at(exact, pose, signed)
        return np.where(np.isfinite(exact), exact, np.maximum(nearest, enough))

    def _edge_distance(self, points: Floats) -> Floats:
        """Return the distance of points, shape (K, 2), to the polygon's nearest edge, shape (K,)."""
        start = self.polygon
        edge = np.roll(start, -1, axis=0) - start
        best = np.full(len(points), np.inf)
        for (ax, ay), (ex, ey) in zip(start, edge, strict=True):
            px, py = points[:, 0] - ax, points[:, 1] - ay
            length = ex * ex + ey * ey
            along = np.clip((px * ex + py * ey) / length, 0.0, 1.0) if length else np.zeros(len(points))
            best = np.minimum(best, np.hypot(px - along * ex, py - along * ey))
        return best

    def _inside(self, points: Floats) -> NDArray[np.bool_]:
        """Return which points, shape (K, 2), are inside the polygon (even-odd rule), shape (K,)."""
        corners = np.array(self.corners, np.float64)
        inside = np.zeros(len(points), np.bool_)
        x, y = points[:, 0], points[:, 1]
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if ay != by:
                crosses = (ay > y) != (by > y)
                inside ^= crosses & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
        return inside


def _padded(corners: Sequence[tuple[float, float]], padding: float) -> list[tuple[float, float]]:
    """Move each corner away from the centre in x and y, as costmap_2d's ``padFootprint`` does."""
    return [(x + float(np.sign(x)) * padding, y + float(np.sign(y)) * padding) for x, y in corners]
