"""Memory for what is read from sockets."""

from __future__ import annotations

import ctypes
import io

_new_bytes = ctypes.pythonapi.PyBytes_FromStringAndSize
_new_bytes.restype = ctypes.py_object
_new_bytes.argtypes = (ctypes.c_char_p, ctypes.c_ssize_t)


def unfilled(size: int) -> io.BytesIO:
    """Return a buffer of a size with whatever was in its memory before.

    ``getbuffer`` lends the memory to be filled, and ``getvalue`` then hands it over as ``bytes``; neither
    copies. Setting it to zero first would take as long as filling it. All of it must be filled before
    anything of it is passed on.

    Args:
        size: Bytes, at least 1.
    """
    return io.BytesIO(_new_bytes(None, size))
