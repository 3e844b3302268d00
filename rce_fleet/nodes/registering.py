"""Registers many topics at the same time: a node of a thousand robots must not wait for the master with each.

:func:`rce.aio.tasks.run_in_groups` does so for robots, :data:`ROBOTS_AT_ONCE` of them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, TypeVar

from rce.ros.closing import Handle, release_all

if TYPE_CHECKING:
    from collections.abc import Awaitable

ROBOTS_AT_ONCE = 100
"""Enough to keep a master busy, and few enough for what waits for it to take little memory."""

H = TypeVar("H", bound=Handle)


async def register_together(*registrations: Awaitable[H]) -> list[H]:
    """Make publishers and subscribers at the same time, all of them or none.

    Args:
        registrations: Such as ``node.advertise("/Robot1/cancelGoal", "std_msgs/Bool")``.

    Returns:
        The handles, in the order of the registrations.

    Raises:
        MasterError: One is not registered, and none is kept; so is what else they raise.
    """
    results = await asyncio.gather(*registrations, return_exceptions=True)
    errors = [result for result in results if isinstance(result, BaseException)]
    handles = [result for result in results if not isinstance(result, BaseException)]
    if errors:
        await release_all(handles)
        raise errors[0]
    return handles
