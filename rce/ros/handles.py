"""Giving back what was taken from a node."""

from __future__ import annotations

import logging
from typing import Protocol

from rce.ros.errors import MasterError

_log = logging.getLogger(__name__)


class Handle(Protocol):
    """A publisher, subscriber or service of a node."""

    async def close(self) -> None:
        """Give it back."""


async def release(handle: Handle) -> None:
    """Close a handle at the end of a block; that the master cannot be told any more is not worth an error."""
    try:
        await handle.close()
    except MasterError as error:
        _log.info("closed without telling the master: %s", error)
