"""A path, and how far along it a robot is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class TrackedPath:
    """A path as a line of points, and the robot's progress along it, which never goes back.

    Args:
        poses: Shape (N, 3): x, y, yaw; at least one.

    Attributes:
        poses: As above.
        at: Length of the path up to each pose, shape (N,), metres.
        progress: How far along the path the robot is, metres.
    """

    def __init__(self, poses: Floats) -> None:
        self.poses = poses
        lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T) if len(poses) > 1 else np.empty(0)
        self.at = np.concatenate(((0.0,), np.cumsum(lengths)))
        self.progress = 0.0

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(self.at[-1])

    def moved(self, poses: Floats) -> TrackedPath:
        """Return the same path in another frame, with the same progress."""
        path = TrackedPath(poses)
        path.progress = self.progress
        return path

    def advance(self, x: float, y: float, reach: float) -> float:
        """Find the robot on the path, at most ``reach`` metres ahead; return its distance from the path."""
        along, away = self.project(np.array(((x, y),)), reach)
        self.progress = max(self.progress, float(along[0]))
        return float(away[0])

    def project(self, points: Floats, reach: float) -> tuple[Floats, Floats]:
        """Find the places on the path that are nearest to points.

        Only the part from the progress to ``reach`` metres after it is searched, so that a path that comes
        back does not pull the robot over.

        Args:
            points: Shape (K, 2), metres.
            reach: Metres.

        Returns:
            Length of the path up to these places, and their distance from the points, both of shape (K,).
        """
        first = max(int(np.searchsorted(self.at, self.progress, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.at, self.progress + reach)) + 1, len(self.at))
        if last - first < 2:  # noqa: PLR2004 - a single point
            first = max(last - 2, 0)
        start = self.poses[first:last, :2]
        if len(start) == 1:
            away = np.hypot(points[:, 0] - start[0, 0], points[:, 1] - start[0, 1])
            return np.full(len(points), self.at[first]), away
        edge = np.diff(start, axis=0)
        length = np.maximum(np.hypot(*edge.T), 1e-12)
        unit = edge / length[:, None]
        dx = points[:, None, 0] - start[None, :-1, 0]
        dy = points[:, None, 1] - start[None, :-1, 1]
        along = np.clip(dx * unit[:, 0] + dy * unit[:, 1], 0.0, length)
        squared = (dx - along * unit[:, 0]) ** 2 + (dy - along * unit[:, 1]) ** 2
        nearest = squared.argmin(axis=1)
        rows = np.arange(len(points))
        return self.at[first:last][nearest] + along[rows, nearest], np.sqrt(squared[rows, nearest])

    def point(self, along: Floats) -> Floats:
        """Return the points at lengths along the path, shape (K, 2); the ends beyond them."""
        return np.stack([np.interp(along, self.at, self.poses[:, axis]) for axis in (0, 1)], axis=1)
