"""Acting as another user of this machine, for a moment."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterator
from contextlib import contextmanager

OTHER_USER = 65534


@contextmanager
def as_user(number: int) -> Iterator[None]:
    """Act as a user inside the block, which must not await: files and sockets are opened as this user."""
    codecs.lookup("idna")  # sockets load it at first use, from files that the user may be unable to read
    own = os.geteuid()
    os.seteuid(number)
    try:
        yield
    finally:
        os.seteuid(own)
