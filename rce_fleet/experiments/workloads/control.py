"""What a source shall send now: a file that the experiment replaces."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

PRINTED, QUIET, END = "printed", "quiet", "end"
START = "start"
"""Name of the phase before the first one, in which sources send small messages until all are connected."""
NOTHING = "-"
"""The stream of a phase in which nothing is sent."""


class Phase(NamedTuple):
    """A part of a run.

    Attributes:
        name: Its name.
        mode: ``printed`` if listeners print the messages, ``quiet`` if they only take them, ``end`` if all
            programs shall tell what they have seen.
        rate: Messages that are to be sent, per second and topic.
        stream: Which of its streams the source sends; empty: all; ``-``: none.
        work_s: Processor time that the source uses before each message, as a simulator to make it, seconds.
    """

    name: str = START
    mode: str = QUIET
    rate: float = 5.0
    stream: str = ""
    work_s: float = 0.0

    @property
    def is_small(self) -> bool:
        """Whether sources send small messages, which are only to be heard."""
        return self.mode == END or self.name == START

    @property
    def frame(self) -> str:
        """The phase as the frame of a message."""
        return f"{self.name}/{self.mode}"


def phase_of(frame: str) -> tuple[str, str]:
    """Return name and mode of the phase that a message is part of."""
    name, _, mode = frame.partition("/")
    return name, mode


class Control:
    """Reads the phase.

    Args:
        path: Of the file; while it does not exist, the phase is the first one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed = 0
        self._phase = Phase()

    def read(self) -> Phase:
        """Return the phase."""
        try:
            changed = self._path.stat().st_mtime_ns
        except FileNotFoundError:
            return self._phase
        if changed != self._changed:
            values: dict[str, Any] = json.loads(self._path.read_text())
            self._changed, self._phase = changed, Phase(**values)
        return self._phase


def give(path: Path, phase: Phase) -> None:
    """Tell a source its phase."""
    new = path.with_suffix(".new")
    new.write_text(json.dumps(phase._asdict()))
    new.replace(path)
