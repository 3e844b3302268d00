"""The header ``Idempotency-Key``: a POST that is sent again after a lost answer is done once.

As in draft-ietf-httpapi-idempotency-key-header: a repeat gets the answer of the first request, 422 if it is
another request, and 409 while the first is under way. Only answers of requests that did something are kept:
one that was refused may be sent again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web

from rce_master.answers import KeyedRequest
from rce_master.exceptions import RefusedError

if TYPE_CHECKING:
    from rce_master.answers import Answer
    from rce_master.state.user_records import User

HEADER = "Idempotency-Key"
REPLAYED = "Idempotent-Replayed"
"""``true`` in an answer that was given before."""
MAX_KEY = 200


def read_key(values: list[str]) -> str:
    """Read the header: a string in quotes (RFC 8941), or the same without them.

    Args:
        values: All that a request has.

    Returns:
        The key; empty: the request has none.

    Raises:
        RefusedError: It is not a key.
    """
    if not values:
        return ""
    text = values[0].strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        text = text[1:-1].replace('\\"', '"').replace("\\\\", "\\")
    if len(values) > 1 or not 0 < len(text) <= MAX_KEY or not text.isascii() or not text.isprintable():
        raise RefusedError(
            f"{HEADER}: expected one key of 1 to {MAX_KEY} printable ASCII characters, such as a UUID"
        )
    return text


def keyed_request(request: web.Request, user: User, body: bytes) -> KeyedRequest | None:
    """Return what identifies a request and its repeats; None if it has no key.

    Raises:
        RefusedError: The header is not a key.
    """
    key = read_key(request.headers.getall(HEADER, []))
    if not key:
        return None
    line = f"{request.method} {request.rel_url.raw_path_qs}\n"
    return KeyedRequest(user.name, key, line.encode() + body)


def replayed(answer: Answer) -> web.Response:
    """Give an answer once more."""
    return web.Response(
        body=answer.body or None,
        status=answer.status,
        content_type="application/json" if answer.body else None,
        headers={REPLAYED: "true"},
    )
