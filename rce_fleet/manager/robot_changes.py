"""Which robots changed since a page asked last: it is not told all of them every few seconds. Pure."""

from __future__ import annotations

from collections.abc import Hashable, Mapping


class RobotChanges:
    """Numbers the changes of robots.

    A robot that is away for a while, and comes back as it was, has not changed.

    Args:
        first: Number of the first version; greater than all versions of a former manager.

    Attributes:
        version: Number of the newest change.

    Example:
        >>> changes = RobotChanges(100)
        >>> changes.since(0, {"Robot1": "idle", "Robot2": "idle"}), changes.version
        (['Robot1', 'Robot2'], 101)
        >>> changes.since(101, {"Robot1": "idle", "Robot2": "task"}), changes.version
        (['Robot2'], 102)
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self.version = first
        self._known: dict[str, tuple[Hashable, int]] = {}
        """By robot: what it was seen as, and the version since which it is."""

    def since(self, version: int, robots: Mapping[str, Hashable]) -> list[str]:
        """Take over what robots are now; return those that changed after a version, in their order.

        Args:
            version: Of an earlier answer; all robots are returned if it is not one of this manager.
            robots: By name, what a page shows of each.
        """
        changed = [name for name, seen in robots.items() if self._known.get(name, (None, 0))[0] != seen]
        if changed:
            self.version += 1
            self._known.update((name, (robots[name], self.version)) for name in changed)
        if not self._first < version <= self.version:
            return list(robots)
        return [name for name in robots if self._known[name][1] > version]
