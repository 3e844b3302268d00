"""Requests that a server answers before its application is loaded: ``GET /`` with a query, sans-I/O.

An application takes 12 MB. A robot asks its engine one question before it connects, in one small request; a
server that gets no others does not load the application. Requests of any other form belong to it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus

MAX_HEAD = 8190
"""Bytes of a request that are looked at, as many as of a line that the application accepts."""

_REQUEST = re.compile(rb"GET /(?:\?([!\"$-~]*))? HTTP/1\.1")
_HEADER = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t -~]*)")
_OF_APPLICATION = frozenset(
    (b"content-length", b"expect", b"origin", b"te", b"trailer", b"transfer-encoding", b"upgrade")
)
"""Headers of requests that need more than an answer."""
_END = b"\r\n\r\n"


class OtherRequestError(Exception):
    """A request is of another form; the application answers it."""


@dataclass(frozen=True, slots=True)
class EntryRequest:
    """A request for the entry of a server."""

    query: str
    """What comes after the ``?``, still percent-encoded."""
    closes: bool
    """Whether the client wants the connection to be closed after the answer."""


@dataclass(frozen=True, slots=True)
class EntryAnswer:
    """An answer to a request for the entry of a server."""

    status: int
    body: bytes
    content_type: str
    headers: Mapping[str, str] = field(default_factory=dict)


def read_entry_request(data: bytes) -> EntryRequest | None:
    """Read a request; return None if more of it must come.

    Args:
        data: All bytes of the connection since its last answer.

    Raises:
        OtherRequestError: It is of another form, too long, or not the only one.
    """
    head, end, rest = data.partition(_END)
    lines = head.split(b"\r\n")
    if rest or len(data) > MAX_HEAD:
        raise OtherRequestError
    if not end:
        if not _may_become_one(lines[0], whole=len(lines) > 1):
            raise OtherRequestError
        return None
    request = _REQUEST.fullmatch(lines[0])
    headers = [_HEADER.fullmatch(line) for line in lines[1:]]
    if request is None or None in headers:
        raise OtherRequestError
    found = [(header[1].lower(), header[2].strip().lower()) for header in headers if header]
    names = [name for name, _ in found]
    if names.count(b"host") != 1 or not _OF_APPLICATION.isdisjoint(names):
        raise OtherRequestError
    requested = [value for name, value in found if name == b"connection"]
    if requested not in ([], [b"keep-alive"], [b"close"]):
        raise OtherRequestError
    return EntryRequest((request[1] or b"").decode(), requested == [b"close"])


def _may_become_one(line: bytes, *, whole: bool) -> bool:
    """Return whether a first line can be that of a request for the entry."""
    if whole:
        return _REQUEST.fullmatch(line) is not None
    return b"GET /".startswith(line[:5]) and (len(line) <= 5 or line[5:6] in b"? ")  # noqa: PLR2004 - of "GET /"


def write_entry_answer(answer: EntryAnswer, *, closes: bool) -> bytes:
    """Return an answer as it is sent.

    Args:
        answer: The answer.
        closes: Whether the connection is closed after it.
    """
    headers = {
        "Content-Type": answer.content_type,
        "Content-Length": str(len(answer.body)),
        **answer.headers,
        **({"Connection": "close"} if closes else {}),
    }
    lines = [
        f"HTTP/1.1 {answer.status} {HTTPStatus(answer.status).phrase}",
        *(f"{name}: {value}" for name, value in headers.items()),
    ]
    return "\r\n".join([*lines, "", ""]).encode() + answer.body
