"""REST: the audit log of logins, refusals and changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import asdict

from rce.web.openapi import Query
from rce_master.audit import STATION, choose
from rce_master.exceptions import ForbiddenError
from rce_master.http import models
from rce_master.http.routes import Call, route_table
from rce_master.state.user_records import UserRole

if TYPE_CHECKING:
    from rce_master.audit import Record

routes = route_table("audit")

MAX_RECORDS = 1000


@routes.route(
    "GET",
    "/audit",
    "Read the audit log, oldest first; to follow it, read on from the last id",
    reply=models.AuditOut,
    admin=True,
    query=(
        Query(name="user", description="Only what this user did."),
        Query(
            name="since",
            description="Id of the last known record; negative: that many of the newest. Default: -100.",
            type="integer",
        ),
    ),
)
async def read_audit(call: Call) -> models.AuditOut:
    """Read records."""
    user, since = call.request.query.get("user", ""), call.number("since", -100)
    audit, others = call.services.audit, call.services.other_audits
    found = audit.since(since, MAX_RECORDS, user)
    missing: list[str] = []
    if others is not None and since < audit.first_id:  # other masters may have led then
        theirs: list[Record]
        theirs, missing = await others.since(since, MAX_RECORDS, user)
        found = choose(sorted([*theirs, *found], key=lambda one: one.id), since, MAX_RECORDS)
    records = [models.AuditRecord(**asdict(record)) for record in found]
    return models.AuditOut(records=records, missing=missing)


@routes.route(
    "POST",
    "/audit",
    "Note what the caller did at a station of this engine",
    body=models.AuditIn,
    status=204,
    any_role=True,
    stations=True,
)
async def note_action(call: Call) -> None:
    """Record a control action; a station sends it with the token of the acting user.

    Any user may do so in their own name. So only the user is believed: the record is marked as told, and
    has the address from which it came beside the one that is told.
    """
    body = call.read(models.AuditIn)
    if call.caller.role is UserRole.VIEWER and body.outcome == "done":
        raise ForbiddenError("role viewer steers nothing, so there is nothing to note")
    call.services.audit.add(
        call.caller.name,
        body.action,
        body.subject,
        detail=body.detail,
        address=call.address,
        via=STATION,
        client=body.address,
        outcome=body.outcome,
    )
