"""Refuses requests to a stand-by that are not the leading master's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web

from rce_master.leadership.request_key import HEADER

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_master.leadership.request_key import RequestKey


class LeaderCheck:
    """Knows the leading master by its header.

    Args:
        key: Tells whether a master asks.
        term: Returns the newest term that this master knows.
    """

    def __init__(self, key: RequestKey, term: Callable[[], int]) -> None:
        self._key = key
        self._term = term

    def __call__(self, request: web.Request) -> None:
        """Refuse a peer that is not the leading master.

        Raises:
            HTTPForbidden: It is another program, or a master that led before.
        """
        term = self._key.read(request.headers.get(HEADER, ""), request.method, request.rel_url.raw_path_qs)
        if term is None:
            raise web.HTTPForbidden(text="only masters of this engine may ask for this")
        if term < self._term():
            raise web.HTTPForbidden(text=f"term {self._term()} has begun; you ask in term {term}")
