"""The standard streams of a program."""

from __future__ import annotations

import os


def open_missing_streams() -> None:
    """Open closed standard streams (``rce up <&-``) on the null device.

    Otherwise the next file or socket takes their number, and what writes to the stream writes to it.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:  # noqa: PLR2004 - standard error
        os.set_inheritable(fd, True)
    os.close(fd)
