"""Requests of the fleet's API about what happened, and about webhooks, which receive what happens."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from urllib.parse import urlencode

from rce_fleet.api.fleet import EventModel, EventPage, StatisticsModel
from rce_fleet.api.webhooks import NewWebhookModel, WebhookList, WebhookModel, WebhookRequest
from rce_fleet.client.event_stream import follow_events
from rce_fleet.client.requests import ApiRequests, parsed, path_part

PAGE = 1000
"""Events of one answer."""


def _history_query(
    since: float | None, until: float | None, subject: str, kinds: Iterable[str], robot: str
) -> dict[str, str]:
    """Return the parameters of a request for a part of the history."""
    times = {"since": since, "until": until}
    query = {name: repr(value) for name, value in times.items() if value is not None}
    given = {"id": subject, "kind": ",".join(kinds), "robot": robot}
    return query | {name: text for name, text in given.items() if text}


class HistoryRequests(ApiRequests):
    """Reads statistics and the history, follows events, and manages webhooks."""

    async def statistics(self, seconds: float = 3600.0) -> StatisticsModel:
        """Return what the fleet did in the last seconds.

        Example:
            ```python
            print((await fleet.statistics()).tasks_per_hour)
            ```
        """
        return await self._read("/statistics", StatisticsModel, {"seconds": f"{seconds:g}"})

    async def history(
        self,
        *,
        since: float | None = None,
        until: float | None = None,
        subject: str = "",
        kinds: Iterable[str] = (),
        robot: str = "",
    ) -> AsyncIterator[EventModel]:
        """Yield events of a time, the oldest first.

        Args:
            since: Seconds since 1970; None: from the beginning.
            until: Seconds since 1970; None: until now.
            subject: Only of this task, robot or zone.
            kinds: Only of these kinds, such as ``task``; empty: all.
            robot: Only those in which this robot took part.

        Example:
            ```python
            async for event in fleet.history(since=time.time() - 3600):
                print(event.text)
            ```
        """
        query = {"limit": str(PAGE)} | _history_query(since, until, subject, kinds, robot)
        while True:
            page = await self._read("/history", EventPage, query)
            for event in page.events:
                yield event
            if len(page.events) < PAGE:  # what happens meanwhile is not waited for
                return
            query["after"] = str(page.next)

    async def history_csv(
        self,
        *,
        since: float | None = None,
        until: float | None = None,
        subject: str = "",
        kinds: Iterable[str] = (),
        robot: str = "",
    ) -> AsyncIterator[str]:
        """Yield the lines of the history as CSV, the names of the columns first.

        Args:
            since: Seconds since 1970; None: from the beginning.
            until: Seconds since 1970; None: until now.
            subject: Only events of this task, robot or zone.
            kinds: Only events of these kinds, such as ``task``; empty: all.
            robot: Only events in which this robot took part.

        Example:
            ```python
            lines = [line async for line in fleet.history_csv(since=time.time() - 86400)]
            ```
        """
        query = {"format": "csv"} | _history_query(since, until, subject, kinds, robot)
        path = f"/history?{urlencode(query)}"
        async for line in self._transport.stream(path, accept="text/csv", headers={}):
            yield line.decode(errors="replace")

    async def events(self, after: int | None = None) -> AsyncIterator[EventModel]:
        """Follow events until the numbers begin anew; a broken stream is resumed where it broke.

        Args:
            after: Begin after this number; None: with the next event.

        Raises:
            ApiError: The station refused, for example because the login has ended.
            EventsForgottenError: The next events are not kept any more; ``events(error.last)`` follows those
                after them.
            EventsRestartedError: The fleet manager lost its journal; ``events(0)`` follows the new one.
            FleetApiUnavailableError: The station cannot be reached, and could not be before.

        Example:
            ```python
            async for event in fleet.events():
                print(event.number, event.text)
            ```
        """
        async for text in follow_events(self._transport, after):
            yield parsed(EventModel, text)

    # Webhooks (administrators)

    async def webhooks(self) -> list[WebhookModel]:
        """Return all receivers of events.

        Example:
            ```python
            print([hook.error for hook in await fleet.webhooks()])
            ```
        """
        return (await self._read("/webhooks", WebhookList)).webhooks

    async def add_webhook(self, webhook: WebhookRequest) -> NewWebhookModel:
        """Send events to a URL from now on; sent once.

        Example:
            ```python
            hook = await fleet.add_webhook(WebhookRequest(url="https://erp.example.com/fleet"))
            ```
        """
        return await self._send("POST", "/webhooks", NewWebhookModel, webhook, repeatable=False)

    async def remove_webhook(self, webhook_id: str) -> None:
        """Remove a receiver of events.

        Example:
            ```python
            await fleet.remove_webhook(hook.id)
            ```
        """
        await self._transport.request("DELETE", f"/webhooks/{path_part(webhook_id)}", repeatable=False)
