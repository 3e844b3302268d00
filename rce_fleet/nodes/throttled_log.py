"""Warnings that repeat: each only once in a while, so that a log stays readable."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce.ros.node import Node
    from rce_fleet.nodes.namespaced import NamespacedNode

EVERY = 5.0
"""Seconds after which the same warning on the same subject is logged again."""
KEPT = 200
"""Warnings that are remembered; with more of them, all are forgotten."""
_NUMBER = re.compile(r"[-+0-9.]+(e[-+]?[0-9]+)?")


class ThrottledLog:
    """Logs warnings of a node, each at most once in ``EVERY`` seconds.

    Texts on one subject that differ in numbers only are the same warning.

    Args:
        node: The node; its log goes to ``/rosout`` too.

    Attributes:
        count: How many warnings there were, also those that were not logged.
    """

    def __init__(self, node: Node | NamespacedNode) -> None:
        self._node = node
        self._logged: dict[tuple[str, str], float] = {}
        self.count = 0

    def warn(self, subject: str, text: str) -> None:
        """Log a warning, unless the same one on the subject was logged a moment ago."""
        self.count += 1
        now, warning = time.monotonic(), (subject, _NUMBER.sub("#", text))
        if now - self._logged.get(warning, float("-inf")) >= EVERY:
            if len(self._logged) >= KEPT:
                self._logged.clear()
            self._logged[warning] = now
            self._node.log.warning("%s", text)
