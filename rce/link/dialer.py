"""Keeps a link up from its dialing end."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.link.exceptions import LinkError

if TYPE_CHECKING:
    from rce.link.hub import LinkHub
    from rce.link.link import Link

_log = logging.getLogger(__name__)

_LONG_ENOUGH = 1.0
"""After a connection that lasted so many seconds, the next pause is short again."""


async def keep_dialed(link: Link, hub: LinkHub) -> None:
    """Dial a link, again whenever its carrier ended. Ends by cancellation only."""
    pauses = hub.timeouts.redial.start()
    while True:
        if not hub.can_reach(link.spec):
            await hub.wait_registered(link.spec.id, None)
        since = hub.loop.time()
        try:
            carrier = await hub.connect(link.spec)
        except (OSError, LinkError) as error:
            _log.debug("link %s to %s: %s", link.spec.id, link.spec.peer, error)
        else:
            link.attach(carrier)
            await carrier.wait_closed()
        if hub.loop.time() - since > _LONG_ENOUGH:
            pauses.reset()
        await hub.wait_registered(link.spec.id, pauses.next())
