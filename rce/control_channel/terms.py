"""The newest term of leadership that a task set has seen: a master of an older one leads no more.

A connection belongs to one term, which ``Welcome`` names: a master that loses the lead closes its control
server. So the messages that follow on the connection do not repeat the term.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Terms:
    """The newest term.

    Args:
        newest: The one that is known from an earlier run of the program.
        keep: Called with each newer one, so that a later run knows it.
    """

    def __init__(self, newest: int = 0, keep: Callable[[int], None] | None = None) -> None:
        self.newest = newest
        self._keep = keep

    def accept(self, term: int) -> bool:
        """Return whether a master of a term may lead, and remember the term.

        Args:
            term: 0: it has no other masters beside it.
        """
        if term in (0, self.newest):
            return True
        if term < self.newest:
            return False
        self.newest = term
        if self._keep is not None:
            self._keep(term)
        return True
