"""Follows the station's server-sent events (WHATWG HTML, section 9.2), and resumes a broken stream."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass

from rce_fleet.client.errors import FleetApiUnavailableError
from rce_fleet.client.transport import RETRY, Transport
from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError


@dataclass(slots=True)
class SentEvent:
    """A server-sent event: its fields as far as they were read.

    Attributes:
        id: A client that connects again sends it as ``Last-Event-ID``.
        name: Empty for an event of the fleet; ``gap`` where numbers begin anew or events are
            not kept any more.
        data: JSON.
    """

    id: str = ""
    name: str = ""
    data: str = ""

    def take(self, line: str) -> None:
        """Take a line of the stream, without its end."""
        field, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if field == "id":
            self.id = value
        elif field == "event":
            self.name = value
        elif field == "data":
            self.data += value


async def follow_events(transport: Transport, after: int | None) -> AsyncIterator[str]:
    """Yield events as JSON; see :meth:`rce_fleet.client.FleetClient.events`.

    Args:
        transport: Sends the requests.
        after: Begin after this number; None: with the next event.

    Raises:
        ApiError: The station refused.
        EventsForgottenError: The next events are not kept any more.
        EventsRestartedError: The numbers began anew.
        FleetApiUnavailableError: The stream could not be opened for the first time.
    """
    last = "" if after is None else str(after)
    pauses = RETRY.start()
    attempts, is_known = 0, False
    while True:
        event = SentEvent()
        headers = {"Last-Event-ID": last} if last else {}
        try:
            async for line in transport.stream("/events", accept="text/event-stream", headers=headers):
                is_known = True
                text = line.decode(errors="replace").rstrip("\r\n")
                if text:
                    event.take(text)
                    continue
                whole, event = event, SentEvent()
                if not whole.data:
                    last = whole.id or last
                    continue
                if whole.name == "gap":
                    gap = json.loads(whole.data)
                    if "to" in gap:
                        raise EventsForgottenError(str(gap["journal"]), int(gap["from"]), int(gap["to"]))
                    raise EventsRestartedError(str(gap["journal"]))
                last = whole.id
                pauses.reset()
                yield whole.data
        except FleetApiUnavailableError:
            attempts += 1
            if not is_known and attempts >= transport.attempts:
                raise
            # Resumed below.
        await asyncio.sleep(pauses.next())
