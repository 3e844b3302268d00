"""When freed memory goes back to the kernel (sans-I/O).

The allocator keeps what large messages freed, because it is soon needed again: up to 128 MB at the end of the
heap, and whatever lies before a block that is still used. Nothing but a look from time to time bounds the
latter, and nothing gives the former back when no more large messages come.
"""

from __future__ import annotations

MOST_UNUSED = 128 << 20
"""Bytes beyond what is in use that are given back even while large messages come."""
LEAST_UNUSED = 16 << 20
"""Bytes beyond what is in use that are not worth the trouble."""


class UnusedMemory:
    """Tells when to give memory back.

    Args:
        resident: Bytes of the process before the first message.

    Attributes:
        idle: Whether memory was, or is to be, given back since messages last came.
    """

    def __init__(self, resident: int) -> None:
        self._own = self._left = resident
        """What the process needs without any message, and what was left when memory was last given back."""
        self._growths = 0
        self.idle = False

    def is_due(self, resident: int, held: int, growths: int) -> bool:
        """Tell whether freed memory is to be given back now; then call :meth:`given_back`.

        Args:
            resident: Bytes of the process.
            held: Bytes of messages that it holds.
            growths: How often it held more than before, since it began.
        """
        used = resident - held
        if growths != self._growths:
            self._growths = growths
            self.idle = False
            return used - self._left > MOST_UNUSED
        # What was left while messages came may have been theirs, so it is looked at once more.
        due = used - (self._left if self.idle else self._own) > LEAST_UNUSED
        self.idle = self.idle or due
        return due

    def given_back(self, resident: int, held: int) -> None:
        """Take note of what is left: asking again at once would give nothing back.

        Args:
            resident: Bytes of the process now.
            held: Bytes of messages that it holds.
        """
        self._left = resident - held
