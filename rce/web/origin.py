"""Keeps pages of other sites from using a server through their visitor's browser."""

from __future__ import annotations

from collections.abc import Collection

from yarl import URL


def is_foreign(origin: str | None, host: str, allowed: Collection[str] = ()) -> bool:
    """Tell whether a request comes from a page of another site.

    Args:
        origin: The request's ``Origin``; programs that are no browser send none.
        host: The request's ``Host``.
        allowed: Origins that may use the server all the same.
    """
    if origin is None or origin in allowed:
        return False
    try:
        return URL(origin).authority != host
    except ValueError:
        return True
