"""The ROS graph that each robot of a world joins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Cores:
    """URIs of ROS masters. A robot without one gets its own graph and no namespace."""

    everybody: str | None = None
    """For robots that are not listed."""
    robots: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, texts: Iterable[str]) -> Cores:
        """Read ``URI`` (for all robots) and ``ROBOT=URI``."""
        everybody, robots = None, {}
        for text in texts:
            robot, separator, uri = text.partition("=")
            if separator and "/" not in robot:
                robots[robot] = uri
            else:
                everybody = text
        return cls(everybody, robots)

    def of(self, robot: str) -> str | None:
        """Return the master of a robot's graph; None for its own graph."""
        return self.robots.get(robot, self.everybody)
