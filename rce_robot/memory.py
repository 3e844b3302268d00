"""Decides when to return freed memory to the kernel (sans-I/O).

The allocator keeps the memory of large messages for reuse: up to 128 MB at the end of the heap, and all
memory before a block that is still used. Without periodic checks the latter is not bounded, and the former is
not returned after the last large message.
"""

from __future__ import annotations

MOST_UNUSED = 128 << 20
"""Unused bytes that are returned even while large messages arrive."""
LEAST_UNUSED = 16 << 20
"""Unused bytes that are too few to return."""


class UnusedMemory:
    """Decides when to return memory.

    Args:
        resident: Bytes of the process before the first message.

    Attributes:
        idle: Whether memory was, or is to be, returned since the last messages.
    """

    def __init__(self, resident: int) -> None:
        self._own = self._left = resident
        """Bytes of the process without messages, and bytes after memory was last returned."""
        self._growths = 0
        self.idle = False

    def is_due(self, resident: int, held: int, growths: int) -> bool:
        """Return whether freed memory is to be returned now; then call :meth:`given_back`.

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
        # The rest may have belonged to arriving messages, so it is checked once more.
        due = used - (self._left if self.idle else self._own) > LEAST_UNUSED
        self.idle = self.idle or due
        return due

    def given_back(self, resident: int, held: int) -> None:
        """Note the remaining memory: another attempt at once would have no effect.

        Args:
            resident: Bytes of the process now.
            held: Bytes of messages that it holds.
        """
        self._left = resident - held
