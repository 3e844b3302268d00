"""The modes that robots which are driven by hand shall have again afterwards. Kept in a file."""

from __future__ import annotations

import threading
from pathlib import Path

import msgspec
from msgspec import Struct

from rce_fleet.station.private_files import fleet_file, write_private


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


class OwedModes:
    """The owed mode of each robot that is driven, or whose mode the planner did not set yet.

    Args:
        file: Where they are kept; None: in memory only.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._file = file
        self._modes: dict[str, OwedMode] = {}
        self._saving = threading.Lock()
        """A save goes on in its thread when the task that waits for it is cancelled."""
        self._revision = self._written = 0

    def load(self) -> None:
        """Read the file; a missing one holds none. Blocks.

        Raises:
            OSError: It cannot be read.
            msgspec.MsgspecError: It is damaged.
        """
        if self._file is not None and self._file.exists():
            self._modes = msgspec.json.decode(self._file.read_bytes(), type=dict[str, OwedMode])

    @property
    def robots(self) -> list[str]:
        """The robots, ascending."""
        return sorted(self._modes)

    def get(self, robot: str) -> OwedMode | None:
        """Return what a robot shall have again; None: nothing."""
        return self._modes.get(robot)

    def owe(self, robot: str, mode: OwedMode) -> None:
        """Note what a robot shall have again."""
        self._modes = {**self._modes, robot: mode}
        self._revision += 1

    def forget(self, robot: str) -> None:
        """Note that a robot has its mode, or another one that was set meanwhile."""
        if robot in self._modes:
            self._modes = {name: mode for name, mode in self._modes.items() if name != robot}
            self._revision += 1

    def save(self) -> None:
        """Write the file, whole or not at all; nothing if it is up to date. Blocks.

        Raises:
            OSError: It cannot be written.
        """
        if self._file is None:
            return
        with self._saving:
            if self._written != self._revision:
                revision, modes = self._revision, self._modes
                write_private(self._file, msgspec.json.encode(modes))
                self._written = revision
