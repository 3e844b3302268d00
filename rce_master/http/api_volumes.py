"""REST: volumes, the folders of users that outlive containers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.http.model import Model, Page
from rce_master.http.paging import PAGE, Listing, Span, answer, keys_of_users
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.http.views import Views
from rce_master.state import commands

if TYPE_CHECKING:
    from aiohttp import web

routes = route_table("volumes")

_QUERY = (OF_USER,)


class VolumeOut(Model):
    """A volume."""

    user: str
    name: str
    size: int
    """Bytes that it may hold."""
    used: int | None
    """Bytes that it holds, as last measured; null if its machine has not reported it."""
    machine: str
    """The machine where it is; empty until its first container has a machine."""
    task_set: str
    """The container task set there."""
    limit: str
    """How its size is enforced there: ``image`` (writes fail) or ``watched`` (its container is ended)."""
    container: str
    """Tag of the container that has it; empty if none."""
    path: str
    """Where that container sees it."""
    snapshots: int
    """Seconds between two snapshots; 0: none are taken."""
    snapshot: float | None
    """When the newest snapshot was taken that the masters hold, in seconds since the epoch; null: none."""
    kept: int
    """Bytes of that snapshot."""
    fault: str
    """Why the last snapshot failed; empty if it did not."""


class VolumesOut(Page):
    """Volumes."""

    volumes: list[VolumeOut]


@routes.route("GET", "/volumes", "List volumes", reply=VolumesOut, query=(*_QUERY, *PAGE))
async def list_volumes(call: Call) -> web.Response:
    """List volumes."""
    tables = call.services.state_service.tables
    views = Views(tables, call.services.reconciler.usage)
    scope = call.scope

    def whole() -> list[str]:
        return sorted(one.id for one in tables.volumes if scope in (None, one.user))

    def items(key: str, span: Span) -> list[tuple[str, VolumeOut]]:
        known = tables.volumes.get(key)
        return [] if known is None else [(name, VolumeOut(**views.volume(known))) for name in span.of(("",))]

    keys = keys_of_users(tables, tables.volumes, "user", scope)
    return await answer(call, Listing(name="volumes", whole=whole, keys=keys, items=items))


@routes.route("DELETE", "/volumes/{name}", "Remove a volume with its files", status=204, query=_QUERY)
async def remove_volume(call: Call) -> None:
    """Remove a volume that no container has."""
    command = commands.RemoveVolume(user=call.owner, name=call.path("name"))
    await call.services.state_service.submit(command)
