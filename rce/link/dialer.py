"""Keeps a link up from its dialing end."""

from __future__ import annotations

import logging
import random
from typing import TYPE_CHECKING

from rce.link.exceptions import LinkError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce.link.hub import LinkHub
    from rce.link.link import Link

log = logging.getLogger(__name__)

_LONG_ENOUGH = 1.0
"""A connection that lasted so many seconds was a good one: the next pause is a short one."""


def pauses(first: float, last: float) -> Iterator[float]:
    """Yield the pauses between attempts in seconds: doubling from ``first`` to ``last``, by half at random.

    The randomness keeps the peers of a restarted process from dialing it all at the same moment.
    """
    pause = first
    while True:
        yield pause * random.uniform(0.5, 1.0)  # noqa: S311 - spreads attempts, protects nothing
        pause = min(last, 2 * pause)


async def keep_dialed(link: Link, hub: LinkHub) -> None:
    """Dial a link for ever, again whenever its carrier ended. Ends by cancellation only."""
    timeouts = hub.timeouts
    waits = pauses(timeouts.redial_first, timeouts.redial_last)
    while True:
        if not hub.can_reach(link.spec):
            await hub.wait_registered(link.spec.id, None)
        since = hub.loop.time()
        try:
            carrier = await hub.connect(link.spec)
        except (OSError, LinkError) as error:
            log.debug("link %s to %s: %s", link.spec.id, link.spec.peer, error)
        else:
            link.attach(carrier)
            await carrier.wait_closed()
        if hub.loop.time() - since > _LONG_ENOUGH:
            waits = pauses(timeouts.redial_first, timeouts.redial_last)
        await hub.wait_registered(link.spec.id, next(waits))
