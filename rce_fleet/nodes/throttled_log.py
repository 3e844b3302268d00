"""Warnings that repeat: one for each subject in a while, so that a log stays readable."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce.ros.node import Node

EVERY = 5.0
"""Seconds after which a warning on the same subject is logged again."""


class ThrottledLog:
    """Logs warnings of a node, each subject at most once in ``EVERY`` seconds.

    Args:
        node: The node; its log goes to ``/rosout`` too.

    Attributes:
        count: How many warnings there were, also those that were not logged.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._logged: dict[str, float] = {}
        self.count = 0

    def warn(self, subject: str, text: str) -> None:
        """Log a warning, unless one on the subject was logged a moment ago."""
        self.count += 1
        now = time.monotonic()
        if now - self._logged.get(subject, float("-inf")) >= EVERY:
            self._logged[subject] = now
            self._node.log.warning("%s", text)
