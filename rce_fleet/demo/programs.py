"""What every mode of the demo does for the demo."""

from __future__ import annotations

from typing import Protocol

from rce_fleet.demo.children import Children
from rce_fleet.demo.counters import Counters

START_TIMEOUT = 90.0
"""Seconds for one program to come up, on a machine that starts many at once."""


class ModePrograms(Protocol):
    """The programs of one mode."""

    async def start(self, children: Children) -> str:
        """Write the files and start everything; returns the URL of the page.

        Raises:
            DemoError: It does not work.
            OSError: A program cannot be started, or a file not written.
        """

    async def count(self) -> Counters:
        """Say how many messages were carried until now.

        Raises:
            DemoError: Nobody says.
        """
