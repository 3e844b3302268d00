"""Lists in answers: page by page, or whole.

A list has *keys* (such as the ids of containers), and a key has *items* (such as the nodes of a container).
Pages are in the order of keys and of the items' names, whole lists in the order of arrival. Both are made in
pieces, between which the event loop has its turn: the list of a large engine takes seconds.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from heapq import nsmallest
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
from aiohttp import web

from rce.web.openapi import Query
from rce_master.exceptions import InvalidRequestError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.http.model import Model
    from rce_master.http.routes import Call
    from rce_master.state.table import Table
    from rce_master.state.tables import Tables

MAX_ITEMS = 1000
"""In one page."""
_PIECE = 50
"""Items between two turns of the event loop."""

Others = Callable[[], Awaitable[Mapping[str, bytes]]]
"""Makes the fields of an answer beside its list, in JSON."""

PAGE = (
    Query(
        name="limit",
        description=f"Most in one answer, up to {MAX_ITEMS}. Default: all; with cursor, {MAX_ITEMS}.",
        type="integer",
    ),
    Query(name="cursor", description="The field next of the page before."),
)
"""The query parameters of lists."""


ALONE = ("",)
"""The name of the only item of a key."""


class Span(NamedTuple):
    """Which names of a key's items to take."""

    after: str | None = None
    """Names after this one; None: from the first on."""
    most: int | None = None
    """So many, in their order; None: all, in the order in which they come."""

    def of(self, names: Iterable[str]) -> list[str]:
        """Choose among names."""
        if self.most is None:
            return list(names)
        return nsmallest(self.most, (name for name in names if self.after is None or name > self.after))


class _Cursor(NamedTuple):
    """The last item of a page."""

    key: str
    name: str

    def write(self) -> str:
        return base64.urlsafe_b64encode(msgspec.json.encode(self)).decode().rstrip("=")

    @classmethod
    def read(cls, text: str) -> _Cursor:
        try:
            packed = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
            return msgspec.json.decode(packed, type=cls)
        except (binascii.Error, msgspec.MsgspecError, ValueError) as error:
            problem = "query parameter 'cursor' is not one that an answer contained"
            raise InvalidRequestError(problem) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Listing:
    """A list in an answer."""

    name: str
    """Its field in the answer."""
    whole: Callable[[], Iterable[str]]
    """Returns all keys, in the order of arrival."""
    keys: Callable[[str, int], list[str]]
    """Returns the keys from one on, at most so many, in their order."""
    items: Callable[[str, Span], Iterable[tuple[str, Model]]]
    """Returns the items of a key, with their names; none if the key is gone meanwhile. Other tasks run while
    the items are iterated over."""


async def answer(call: Call, listing: Listing, others: Others | None = None) -> web.Response:
    """Answer a request for a list, once no other list is made for the caller.

    Args:
        call: The request.
        listing: The list.
        others: Makes other fields of the answer.

    Raises:
        InvalidRequestError: ``limit`` or ``cursor`` is wrong.
        TooMuchError: Too many lists of the caller wait.
    """
    query = call.request.query
    cursor = _Cursor.read(query["cursor"]) if query.get("cursor") else None
    limit = call.number("limit", MAX_ITEMS)
    if not 0 < limit <= MAX_ITEMS:
        raise InvalidRequestError(f"query parameter 'limit' must be 1 to {MAX_ITEMS}")
    is_whole = cursor is None and "limit" not in query
    async with call.services.quotas.making_list(call.caller):
        fields = {} if others is None else await others()
        rows, after = (await _whole(listing), None) if is_whole else await _page(listing, limit, cursor)
        body = _body(listing, rows, after, fields)
    return web.Response(body=body, content_type="application/json")


async def whole(call: Call, listing: Listing, others: Others) -> bytes:
    """Return the JSON of an answer with a whole list, once no other list is made for the caller.

    Args:
        call: The request.
        listing: The list.
        others: Makes other fields of the answer.

    Raises:
        TooMuchError: Too many lists of the caller wait.
    """
    async with call.services.quotas.making_list(call.caller):
        fields = await others()
        return _body(listing, await _whole(listing), None, fields)


def _body(listing: Listing, rows: list[bytes], after: str | None, others: Mapping[str, bytes]) -> bytes:
    fields = {**others, listing.name: b"[%s]" % b",".join(rows), "next": msgspec.json.encode(after)}
    return b"{%s}" % b",".join(b'"%s":%s' % (name.encode(), value) for name, value in fields.items())


async def _whole(listing: Listing) -> list[bytes]:
    rows: list[bytes] = []
    for number, key in enumerate(listing.whole(), 1):
        for _, item in listing.items(key, Span()):
            rows.append(_encode(item))
            if len(rows) % _PIECE == 0:
                await asyncio.sleep(0)
        if number % _PIECE == 0:
            await asyncio.sleep(0)
    return rows


async def _page(listing: Listing, limit: int, cursor: _Cursor | None) -> tuple[list[bytes], str | None]:
    rows: list[bytes] = []
    last, start = cursor, cursor.key if cursor is not None else ""
    while True:
        keys = listing.keys(start, limit + 1)
        has_more = len(keys) > limit
        for key in keys[:limit]:
            after = cursor.name if cursor is not None and key == cursor.key else None
            for name, item in listing.items(key, Span(after, limit + 1 - len(rows))):
                if len(rows) == limit:
                    return rows, last.write() if last is not None else None
                rows.append(_encode(item))
                last = _Cursor(key, name)
                if len(rows) % _PIECE == 0:
                    await asyncio.sleep(0)
        if not has_more:
            return rows, None
        start = keys[-1]
        await asyncio.sleep(0)


def _encode(item: Model) -> bytes:
    return item.model_dump_json(by_alias=True).encode()


def keys_of_users(
    tables: Tables, table: Table[Any], index: str, scope: str | None
) -> Callable[[str, int], list[str]]:
    """Return what finds keys that begin with ``user/``, in the order of users, then of keys.

    Only the keys of the users that a page is about are sorted.

    Args:
        tables: The tables.
        table: The table with the keys.
        index: Its index by user.
        scope: Only this user's; None: those of all.
    """

    def keys(start: str, most: int) -> list[str]:
        first = start.partition("/")[0]
        users = sorted(user.name for user in tables.users if user.name >= first) if scope is None else [scope]
        found: list[str] = []
        for user in users:
            own = table.keys(index, user)
            found += nsmallest(most - len(found), (key for key in own if user != first or key >= start))
            if len(found) == most:
                break
        return found

    return keys


def keys_of(table: Table[Any]) -> Callable[[str, int], list[str]]:
    """Return what finds a table's keys, in their order."""

    def keys(start: str, most: int) -> list[str]:
        return nsmallest(most, (key for key in map(table.key, table) if key >= start))

    return keys
