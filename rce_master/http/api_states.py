"""REST: saved states of nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.http.model import Model, Page
from rce_master.http.paging import PAGE, Listing, Span, answer, keys_of_users
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.state import commands

if TYPE_CHECKING:
    from aiohttp import web

    from rce_master.state.tables import Tables
    from rce_master.state.volume_records import SavedState

routes = route_table("states")

_QUERY = (OF_USER,)


class StateOut(Model):
    """The newest snapshot of a node's state."""

    user: str
    container: str
    node: str
    size: int
    """Bytes."""
    sha256: str
    """In hex."""
    taken: float
    """When the master acknowledged it; seconds since 1970."""
    machine: str
    """The machine where it was taken; empty if it is gone."""
    number: int
    """Grows from snapshot to snapshot, until the container is made again."""


class StatesOut(Page):
    """Saved states of nodes."""

    states: list[StateOut]


@routes.route("GET", "/states", "List saved states of nodes", reply=StatesOut, query=(*_QUERY, *PAGE))
async def list_states(call: Call) -> web.Response:
    """List saved states of nodes."""
    tables = call.services.state_service.tables
    scope = call.scope

    def whole() -> list[str]:
        return sorted(one.id for one in tables.saved_states if scope in (None, one.user))

    def items(key: str, span: Span) -> list[tuple[str, StateOut]]:
        known = tables.saved_states.get(key)
        return [] if known is None else [(name, _shown(tables, known)) for name in span.of(("",))]

    keys = keys_of_users(tables, tables.saved_states, "user", scope)
    return await answer(call, Listing(name="states", whole=whole, keys=keys, items=items))


@routes.route(
    "DELETE",
    "/states/{container}/{node}",
    "Remove the saved state of a node",
    status=204,
    query=_QUERY,
)
async def remove_state(call: Call) -> None:
    """Remove the saved state of a node; it starts without it next time, unless it is saved again before."""
    command = commands.RemoveState(user=call.owner, container=call.path("container"), node=call.path("node"))
    await call.services.state_service.submit(command)


def _shown(tables: Tables, known: SavedState) -> StateOut:
    task_set = tables.task_sets.get(known.process)
    return StateOut(
        user=known.user,
        container=known.container.partition("/")[2],
        node=known.node,
        size=known.size,
        sha256=known.sha256,
        taken=known.taken,
        machine="" if task_set is None else task_set.machine.name,
        number=known.number,
    )
