"""Delivers events to webhooks: in order, signed, again and again until the receiver has taken them.

Nothing is queued here: each webhook has a position in the fleet manager's journal, which is kept over a
restart of the station. A receiver may get an event twice, and knows it by its number.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import aiohttp
from aiohttp.abc import AbstractResolver, ResolveResult

from rce.aio.backoff import Backoff
from rce.web.client import NameResolver
from rce_fleet.api.webhooks import SIGNATURE, TIMESTAMP, WEBHOOK, sign
from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError, RequestRefusedError
from rce_fleet.station.events import EventCursor, EventFeed, FleetEvent
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.webhook_store import Webhook, WebhookStore, check_url, is_private

if TYPE_CHECKING:
    from asyncio import TaskGroup

_log = logging.getLogger(__name__)

RETRY = Backoff(first=1.0, longest=300.0)
TIMEOUT = aiohttp.ClientTimeout(total=10.0)
BATCH = 100
"""Events of one delivery."""
KEEP_EVERY = 1000
"""A position is kept after so many events that its receiver does not want: far fewer than are kept."""
_OK = range(200, 300)
_AWAY_S = 2.0
_SHOWN = 200


class PublicResolver(AbstractResolver):
    """Looks names up, and leaves out addresses that are not of the public Internet."""

    def __init__(self) -> None:
        self._names = NameResolver()

    async def resolve(
        self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_INET
    ) -> list[ResolveResult]:
        """Return the public addresses of a name.

        Raises:
            OSError: It has none.
        """
        found = await self._names.resolve(host, port, family)
        public = [one for one in found if not is_private(one["host"])]
        if not public:
            raise OSError(None, f"{host} is in a private network now; set allow_private if it shall be used")
        return public

    async def close(self) -> None:
        """Close the resolver."""
        await self._names.close()


class WebhookSender:
    """Runs a task for each webhook.

    Args:
        store: The webhooks.
        feed: The events.
        clock: Seconds since 1970.
        retry: Pauses after failures.
    """

    def __init__(
        self,
        store: WebhookStore,
        feed: EventFeed,
        *,
        clock: Callable[[], float] = time.time,
        retry: Backoff = RETRY,
    ) -> None:
        self._store = store
        self._feed = feed
        self._clock = clock
        self._retry = retry
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._kept: dict[str, int] = {}
        """The position of each webhook when it was kept last, or could not be."""
        self._group: TaskGroup | None = None
        self._saving = asyncio.Lock()

    async def run(self) -> None:
        """Deliver until cancelled."""
        async with asyncio.TaskGroup() as self._group:
            for webhook in self._store:
                self.start(webhook)
            await asyncio.Event().wait()

    def start(self, webhook: Webhook) -> None:
        """Begin to deliver to a webhook."""
        self._kept[webhook.id] = webhook.position
        if self._group is not None:
            task = self._group.create_task(self._deliver(webhook), name=f"webhook {webhook.id}")
            self._tasks[webhook.id] = task

    async def stop(self, id_: str) -> None:
        """Deliver nothing more to a webhook."""
        task = self._tasks.pop(id_, None)
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await asyncio.wait([task])

    async def save(self) -> None:
        """Keep the webhooks and their positions.

        Raises:
            OSError: The file cannot be written.
        """
        async with self._saving:
            await asyncio.to_thread(self._store.save)

    async def _deliver(self, webhook: Webhook) -> None:
        cursor = EventCursor(self._feed, webhook.position, webhook.journal)
        resolver = NameResolver() if webhook.allow_private else PublicResolver()
        connector = aiohttp.TCPConnector(resolver=resolver, limit=1, force_close=True)
        async with aiohttp.ClientSession(connector=connector, timeout=TIMEOUT) as session:
            while True:
                try:
                    found = await cursor.next()
                except PlannerUnavailableError:
                    await asyncio.sleep(_AWAY_S)
                    continue
                except EventsRestartedError as restarted:
                    await self._send(session, webhook, (), restarted.journal)
                    continue
                except EventsForgottenError as forgotten:
                    webhook.journal = cursor.journal
                    await self._send(session, webhook, (), forgotten=forgotten)
                    continue
                webhook.journal = cursor.journal
                for first in range(0, len(found), BATCH):
                    await self._send(session, webhook, found[first : first + BATCH])

    async def _send(
        self,
        session: aiohttp.ClientSession,
        webhook: Webhook,
        events: Sequence[FleetEvent],
        new_journal: str = "",
        forgotten: EventsForgottenError | None = None,
    ) -> None:
        """Send events, or that a new journal numbers them or some are gone, until the receiver took it."""
        wanted = [event for event in events if not webhook.kinds or event["kind"] in webhook.kinds]
        said: dict[str, Any] = {"webhook": webhook.id, "journal": new_journal or webhook.journal}
        is_gap = bool(new_journal) or forgotten is not None
        said |= {"gap": True, "events": []} if is_gap else {"events": wanted}
        if forgotten is not None:
            said |= {"from": forgotten.first, "to": forgotten.last}
        while (wanted or is_gap) and (error := await self._post(session, webhook, said)):
            webhook.failures += 1
            pause = self._retry.pause_after(webhook.failures)
            webhook.error, webhook.next_attempt = error, self._clock() + pause
            _log.warning("webhook %s: %s; tried again in %.0f s", webhook.id, error, pause)
            await self._keep(webhook)
            await asyncio.sleep(pause)
        webhook.failures, webhook.error, webhook.next_attempt = 0, "", None
        if new_journal:
            webhook.journal, webhook.position = new_journal, 0
        elif forgotten is not None:
            webhook.position = forgotten.last
        else:
            webhook.position = int(events[-1]["number"])
        if wanted or is_gap or webhook.position - self._kept[webhook.id] >= KEEP_EVERY:
            await self._keep(webhook)

    async def _keep(self, webhook: Webhook) -> None:
        self._kept[webhook.id] = webhook.position
        try:
            await self.save()
        except OSError as error:
            _log.error("the position of webhook %s is not kept: %s", webhook.id, error)

    async def _post(self, session: aiohttp.ClientSession, webhook: Webhook, said: dict[str, Any]) -> str:
        """Send a delivery once; return why the receiver did not take it."""
        body = json.dumps(said).encode()
        timestamp = str(int(self._clock()))
        headers = {
            "Content-Type": "application/json",
            WEBHOOK: webhook.id,
            TIMESTAMP: timestamp,
            SIGNATURE: sign(webhook.secret, timestamp, body),
        }
        try:
            check_url(webhook.url, allow_private=webhook.allow_private)
            async with session.post(webhook.url, data=body, headers=headers, allow_redirects=False) as reply:
                return "" if reply.status in _OK else f"the receiver answered {reply.status}"
        except (
            aiohttp.ClientError,
            RequestRefusedError,
            OSError,
            ValueError,
        ) as error:  # no host
            return (str(error) or type(error).__name__)[:_SHOWN]
