"""The API for an ERP at the station: requests to the fleet manager, events, history and webhooks."""

from __future__ import annotations

import asyncio
import json
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from rce.web.openapi import PREFIX, Operation, Query
from rce.web.routes import Route
from rce_fleet.api.fleet import EventPage
from rce_fleet.api.webhooks import NewWebhookModel, WebhookList, WebhookRequest
from rce_fleet.station.access import with_known_query
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.event_streams import CSV, EVENT_STREAM, EventStreams, Work
from rce_fleet.station.events import EventBatch, EventFeed
from rce_fleet.station.figures import STATISTICS_PATH
from rce_fleet.station.fleet_requests import ROUTES, FleetRequests
from rce_fleet.station.manager_watch import ManagerWatch
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.webhook_sender import WebhookSender
from rce_fleet.station.webhook_store import WebhookStore
from rce_fleet.station.webhooks import Webhooks

if TYPE_CHECKING:
    from aiohttp import web

    from rce_fleet.station.access import AccessControl
    from rce_fleet.station.api import CellRequest
    from rce_fleet.station.authentication import StationUser
    from rce_fleet.station.fleet_link import FleetLink

_OK = 200
_UNAVAILABLE = (503, 507)
_PAGE = (
    Query(name="after", description="Events after this number.", type="integer"),
    Query(name="limit", description="Most in one answer.", type="integer"),
    Query(name="id", description="Of one task, robot, zone ... only."),
    Query(name="kind", description="Of these kinds only, separated by commas: task, robot, zone ..."),
    Query(name="robot", description="Only those in which this robot took part, also of its tasks."),
)
_TIME = (
    Query(name="since", description="Seconds since 1970.", type="number"),
    Query(name="until", description="Seconds since 1970.", type="number"),
    Query(name="format", description="json (default) or csv; Accept: text/csv does the same."),
)
_READS = (401, 403, 404, 421, 422, 429, 503, 507)
_ADMIN = (400, 401, 403, 404, 408, 409, 413, 421, 507)


class FleetApi:
    """The routes, and the tasks behind them.

    Args:
        fleet: The link to planner and manager.
        access: Checks what users may do.
        webhooks: File in which webhooks are kept; None keeps them in memory.
        has_roles: Whether users have roles.

    Attributes:
        feed: The newest events.
        store: The webhooks.
        manager: Whether the fleet manager answers.
    """

    def __init__(
        self, fleet: FleetLink, access: AccessControl, webhooks: Path | None = None, *, has_roles: bool = True
    ) -> None:
        self._fleet = fleet
        self._requests = FleetRequests(fleet, access)
        self.feed = EventFeed(self._ask)
        self.manager = ManagerWatch(self.feed.locate, lambda: fleet.can_ask_manager)
        self.store = WebhookStore(webhooks)
        self._sender = WebhookSender(self.store, self.feed)
        streams = EventStreams(self._requests, self.feed, access)
        hooks = Webhooks(self.store, self._sender, self.feed, access, has_roles=has_roles)
        self._routes = _own_routes(streams, hooks)

    async def load(self) -> None:
        """Read the webhooks that were kept.

        Raises:
            OSError: They cannot be read.
        """
        try:
            await asyncio.to_thread(self.store.load)
        except msgspec.DecodeError as error:
            raise OSError(f"the file of webhooks is damaged: {error}; remove it from --state-dir") from error

    async def run(self) -> None:
        """Deliver to webhooks, and watch the manager, until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._sender.run())
            group.create_task(self.manager.run())

    async def statistics(self) -> dict[str, Any] | None:
        """Return the manager's statistics of the last ten minutes; None without a manager.

        Raises:
            PlannerUnavailableError: The manager does not answer.
        """
        if not self.manager.here:
            return None
        answer = await self._requests.ask("GET", STATISTICS_PATH, user=None)
        found: dict[str, Any] | None = json.loads(answer["body"]) if answer["status"] == _OK else None
        return found

    @property
    def operations(self) -> list[Operation]:
        """The entries of the OpenAPI document."""
        return [*(route.operation for route in ROUTES), *(route.operation for route in self._routes)]

    def add_to(self, app: web.Application) -> None:
        """Add the routes to an application."""
        for passed_on in ROUTES:
            handler = partial(self._requests.handle, action=passed_on.handler)
            app.router.add_route(
                passed_on.method, PREFIX + passed_on.path, with_known_query(passed_on, handler)
            )
        for route in self._routes:
            app.router.add_route(route.method, PREFIX + route.path, with_known_query(route, route.handler))

    async def set_goal(self, robot: str, cell: int | None, *, user: StationUser) -> str:
        """Send a robot to a cell, or stop it (None); return the answer for people.

        The fleet manager has the goal in its journal before it answers. In a fleet without one, and while it
        does not run, the planner is asked.

        Args:
            robot: The robot.
            cell: The goal.
            user: Who asks.

        Raises:
            PlannerError: It was refused, or neither of them answers.
        """
        said = await self._by_manager(f"/robots/{quote(robot, safe='')}/goal", {"cell": cell}, user)
        if said is None:
            said = await self._fleet.set_goal(robot, cell)
            if not self.manager.here:
                return said
        self._fleet.forget_goal(robot)
        return said

    async def block_cell(self, cell: int, asked: CellRequest, *, user: StationUser) -> str:
        """Block or free a cell; return the answer for people.

        It is kept as a goal is.

        Args:
            cell: The cell.
            asked: Whether to block it, why, and until when.
            user: Who asks.

        Raises:
            PlannerError: It was refused, or neither of them answers.
        """
        said = await self._by_manager(f"/cells/{cell}", asked.model_dump(exclude_defaults=True), user)
        if said is None:
            said = await self._fleet.block_cell(_desired(cell, asked, user))
            if not self.manager.here:
                return said
        self._fleet.forget_cell(cell)
        return said

    async def set_mode(self, mode: str, *, reason: str, user: StationUser) -> str:
        """Pause the fleet, or let it drive; return the answer for people.

        It is kept as a goal is.

        Args:
            mode: ``automatic`` or ``paused``.
            reason: Why, for people.
            user: Who asks.

        Raises:
            PlannerError: It was refused, or neither of them answers.
        """
        said = await self._by_manager("/mode", {"mode": mode, "reason": reason}, user)
        return said or await self._fleet.set_mode("", mode, reason=reason, user=user.name)

    async def _by_manager(self, path: str, body: dict[str, object], user: StationUser) -> str | None:
        """Send a request to the fleet manager; None: there is none, or it does not run.

        Raises:
            PlannerError: It was refused, or a manager that may still begin does not answer yet.
        """
        await self.manager.looked()
        if not self.manager.was_here:
            if self._fleet.expects_manager and not await self.manager.comes():
                raise PlannerUnavailableError("the fleet manager does not answer yet; try again")
            if not self.manager.was_here:
                return None
        try:
            answer = await self._requests.ask("PUT", path, user=user, body=json.dumps(body))
        except PlannerUnavailableError:
            if self.manager.here:
                raise
            return None
        said = json.loads(answer["body"])
        if answer["status"] == _OK:
            return str(said["message"])
        if answer["status"] in _UNAVAILABLE:
            raise PlannerUnavailableError(said["error"])
        raise PlannerError(said["error"])

    async def _ask(self, number: int, limit: int) -> EventBatch:
        answer = await self._requests.ask("GET", f"/events?after={number}&limit={limit}", user=None)
        if answer["status"] != _OK:
            raise PlannerUnavailableError(f"the fleet manager has no events now: {answer['body']}")
        page = json.loads(answer["body"])
        return EventBatch(page["events"], page["journal"], page["newest"])


def _desired(cell: int, asked: CellRequest, user: StationUser) -> DesiredCell:
    """Return what a user wants of a cell.

    Raises:
        PlannerError: Its end has passed.
    """
    if not asked.blocked:
        return DesiredCell(cell, blocked=False)
    now = time.time()
    if asked.until is not None and asked.until <= now:
        raise PlannerError(f"cell {cell}: the end {asked.until:.0f} is not after now ({now:.0f})")
    return DesiredCell(cell, True, user.name, asked.reason, now, asked.until)


def _own_routes(streams: EventStreams, hooks: Webhooks) -> list[Route[Work]]:
    def route(method: str, path: str, handler: Work, summary: str, **options: object) -> Route[Work]:
        made = {"group": path.split("/")[1], "errors": _READS, **options}
        return Route(method=method, path=path, handler=handler, summary=summary, **made)  # type: ignore[arg-type]  # fields of Route

    return [
        route(
            *("GET", "/events", streams.events, "Return events; with Accept: text/event-stream, follow them"),
            reply=EventPage,
            other_media=(EVENT_STREAM,),
            query=_PAGE,
            name="list_events",
        ),
        route(
            *("GET", "/history", streams.history, "Return the events of a time, as JSON or CSV"),
            reply=EventPage,
            other_media=(CSV,),
            query=(*_PAGE, *_TIME),
            name="list_history",
        ),
        route("GET", "/webhooks", hooks.list_webhooks, "List webhooks", reply=WebhookList, errors=_ADMIN),
        route(
            *("POST", "/webhooks", hooks.add_webhook, "Send events to a URL from now on"),
            body=WebhookRequest,
            reply=NewWebhookModel,
            status=201,
            errors=(*_ADMIN, 503),
        ),
        route(
            *("DELETE", "/webhooks/{webhook}", hooks.remove_webhook, "Remove a webhook"),
            status=204,
            errors=_ADMIN,
        ),
    ]
