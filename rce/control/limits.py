"""What the master and the container task sets must agree on about limits of containers."""

from __future__ import annotations

MEGABYTE = 1 << 20
"""What is called MB where memory is spoken of: bytes."""
MIN_MEMORY = 32 * MEGABYTE
"""A container cannot live with less memory (bytes): its environment alone needs most of this."""
MEMORY_PER_SLOT = 64 * MEGABYTE
"""A machine offers one slot for so many bytes of its memory, unless its operator says otherwise."""
