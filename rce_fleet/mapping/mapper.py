"""What mappers have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord


class Mapper(Protocol):
    """Finds the robot's way from scans, one after the other; the frame is the base at the first scan."""

    @property
    def loop_closures(self) -> int:
        """How often places were recognized so far."""

    def add(self, record: LaserRecord) -> None:
        """Use the next scan of a robot's log."""

    def finish(self) -> None:
        """Improve what was estimated, after the last scan."""

    def trajectory(self) -> NDArray[np.float64]:
        """Return the estimated pose of the base at each scan that was added, shape (N, 3)."""
