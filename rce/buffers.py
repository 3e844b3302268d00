"""Memory for reads from sockets, and writing of several buffers at once."""

from __future__ import annotations

import asyncio
import ctypes
import io
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_new_bytes = ctypes.pythonapi.PyBytes_FromStringAndSize
_new_bytes.restype = ctypes.py_object
_new_bytes.argtypes = (ctypes.c_char_p, ctypes.c_ssize_t)


def unfilled(size: int) -> io.BytesIO:
    """Return a buffer of a size whose memory is not initialized.

    ``getbuffer`` lends the memory to be filled, and ``getvalue`` then hands it over as ``bytes``; neither
    copies. Setting it to zero first would take as long as filling it. All of it must be filled before
    anything of it is passed on.

    Args:
        size: Bytes, at least 1.
    """
    return io.BytesIO(_new_bytes(None, size))


_FORGETS_TO_PAUSE = (3, 12) <= sys.version_info < (3, 13, 1)
"""Whether asyncio's ``writelines`` never calls ``pause_writing``."""


def write_together(
    transport: asyncio.WriteTransport, buffers: Sequence[bytes | bytearray | memoryview]
) -> None:
    """Write buffers one after the other, with one system call where the event loop can (uvloop).

    Besides the call, that saves the receiver a wake-up with a header alone. The protocol is told to pause as
    after ``write``.
    """
    if type(transport).writelines is asyncio.WriteTransport.writelines:  # it would copy all
        for buffer in buffers:
            transport.write(buffer)
        return
    transport.writelines(buffers)
    if _FORGETS_TO_PAUSE:
        low, high = transport.get_write_buffer_limits()
        transport.set_write_buffer_limits(high, low)  # looks at what waits
