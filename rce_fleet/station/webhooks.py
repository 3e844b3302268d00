"""The routes of webhooks: administrators add and remove receivers of events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aiohttp import web

from rce_fleet.api.webhooks import NewWebhookModel, WebhookList, WebhookModel, WebhookRequest
from rce_fleet.station.access import USER, problem
from rce_fleet.station.fleet_requests import read_body
from rce_fleet.station.webhook_store import check_url

if TYPE_CHECKING:
    from rce_fleet.station.access import AccessControl
    from rce_fleet.station.events import EventFeed
    from rce_fleet.station.webhook_sender import WebhookSender
    from rce_fleet.station.webhook_store import Webhook, WebhookStore


class Webhooks:
    """Handlers of ``/webhooks``.

    Args:
        store: The webhooks.
        sender: Delivers to them.
        feed: Tells the number of the newest event.
        access: Keeps the audit log.
        has_roles: Whether users have roles; without an engine, who has the token may do everything.
    """

    def __init__(
        self,
        store: WebhookStore,
        sender: WebhookSender,
        feed: EventFeed,
        access: AccessControl,
        *,
        has_roles: bool,
    ) -> None:
        self._feed = feed
        self._store = store
        self._sender = sender
        self._access = access
        self._has_roles = has_roles

    async def list_webhooks(self, request: web.Request) -> web.StreamResponse:
        """Return all webhooks, without their secrets."""
        if (refusal := self._refusal(request, "list_webhooks")) is not None:
            return refusal
        found = WebhookList(webhooks=[WebhookModel(**_shown(webhook)) for webhook in self._store])
        return _reply(found.model_dump_json())

    async def add_webhook(self, request: web.Request) -> web.StreamResponse:
        """Add a webhook; it gets events from now on."""
        if (refusal := self._refusal(request, "add_webhook")) is not None:
            return refusal
        asked = WebhookRequest.model_validate_json(await read_body(request, self._access))
        check_url(asked.url, allow_private=asked.allow_private)
        position = await self._feed.locate()
        made = self._store.add(asked, request[USER].name, position, self._feed.journal)
        try:
            await self._sender.save()
        except OSError as error:
            self._store.remove(made.id)
            return problem(507, f"the webhook cannot be kept: {error.strerror}; check --state-dir")
        self._sender.start(made)
        self._access.audit(request, "add_webhook", made.id, made.url[:300])
        return _reply(NewWebhookModel(**_shown(made), secret=made.secret).model_dump_json(), 201)

    async def remove_webhook(self, request: web.Request) -> web.StreamResponse:
        """Remove a webhook."""
        id_ = request.match_info["webhook"]
        if (refusal := self._refusal(request, "remove_webhook")) is not None:
            return refusal
        webhook = self._store.get(id_)
        if webhook is None or not self._store.remove(id_):
            return problem(404, f"there is no webhook {id_[:40]!r}")
        await self._sender.stop(id_)
        try:
            await self._sender.save()
        except OSError as error:  # a station that is started again would send to it
            self._store.put_back(webhook)
            self._sender.start(webhook)
            return problem(507, f"the webhook cannot be removed: {error.strerror}; check --state-dir")
        self._access.audit(request, "remove_webhook", id_)
        return web.Response(status=204)

    def _refusal(self, request: web.Request, action: str) -> web.Response | None:
        user = request[USER]
        if user.may_control and (user.role == "admin" or user.is_anonymous or not self._has_roles):
            return None
        self._access.audit(request, action, "webhooks", done=False)
        return problem(403, f"user {user.name!r} has the role {user.role}; webhooks are for administrators")


def _shown(webhook: Webhook) -> dict[str, Any]:
    return {
        "id": webhook.id,
        "url": webhook.url,
        "kinds": list(webhook.kinds),
        "allow_private": webhook.allow_private,
        "created_by": webhook.created_by,
        "position": webhook.position,
        "failures": webhook.failures,
        "error": webhook.error,
        "next_attempt": webhook.next_attempt,
    }


def _reply(text: str, status: int = 200) -> web.Response:
    return web.Response(status=status, text=text, content_type="application/json")
