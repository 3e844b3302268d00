"""The modes that robots which are driven by hand shall have again afterwards. Kept in a file."""

from __future__ import annotations

from pathlib import Path

from msgspec import Struct

from rce_fleet.station.private_files import KeptInFile, fleet_file


class OwedMode(Struct, kw_only=True, frozen=True):
    """What a robot had before it was driven by hand.

    Attributes:
        mode: Its own mode.
        user: Who drives it, or drove it.
    """

    mode: str
    user: str


def modes_file(folder: Path, fleet: str) -> Path:
    """Return the file of a fleet's owed modes.

    Args:
        folder: The folder.
        fleet: What tells the fleet from others.
    """
    return fleet_file(folder, "modes", fleet)


class OwedModes(KeptInFile[dict[str, OwedMode]]):
    """The owed mode of each robot that is driven, or whose mode the planner did not set yet.

    Args:
        file: Where they are kept; None: in memory only.
    """

    def __init__(self, file: Path | None = None) -> None:
        super().__init__(dict[str, OwedMode], {}, file)

    @property
    def robots(self) -> list[str]:
        """The robots, ascending."""
        return sorted(self._content)

    def get(self, robot: str) -> OwedMode | None:
        """Return what a robot shall have again; None: nothing."""
        return self._content.get(robot)

    def owe(self, robot: str, mode: OwedMode) -> None:
        """Note what a robot shall have again."""
        self._content = {**self._content, robot: mode}
        self._revision += 1

    def forget(self, robot: str) -> None:
        """Note that a robot has its mode, or another one that was set meanwhile."""
        if robot in self._content:
            self._content = {name: mode for name, mode in self._content.items() if name != robot}
            self._revision += 1
