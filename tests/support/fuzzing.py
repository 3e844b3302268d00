"""Requests that no client would send, and what must hold of the answers to them."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import re
from typing import TYPE_CHECKING, Any

import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from schemathesis import GenerationMode, checks
from schemathesis.core.result import Ok
from schemathesis.specs.openapi import checks as openapi_checks

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

EXAMPLES = int(os.environ.get("RCE_FUZZ_EXAMPLES", "0"))
"""More of them than in the suite, and other ones each time: ``make fuzz``."""
SEED = random.SystemRandom().randrange(2**32) if EXAMPLES else 7
CASES = 4
"""Requests for each operation and mode."""
CHECKS = [
    checks.not_a_server_error,
    openapi_checks.status_code_conformance,
    openapi_checks.content_type_conformance,
    openapi_checks.response_schema_conformance,
]
ANSWER_S = 60.0
MOMENT_S = 0.05
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})")

METHODS = (
    b"GET",
    b"POST",
    b"PUT",
    b"DELETE",
    b"PATCH",
    b"HEAD",
    b"OPTIONS",
    b"TRACE",
    b"get",
    b"",
    b"\xff",
    b"A" * 70,
)
VERSIONS = (b"HTTP/1.1", b"HTTP/1.0", b"HTTP/2.0", b"HTTP/9", b"", b"HTTP/1.1 x", b"\xff")
NASTY = (
    b"my-box",
    b"..",
    b"%2e%2e%2f%2e%2e%2fetc",
    b"%00",
    b"%ff%fe",
    b"%",
    b"%zz",
    b"\xc3\xa9",
    b"\xff\xfe",
    "\u0661\u0662".encode(),
    b"%d9%a1",
    b"%ed%a0%80",
    b"-1",
    b"9" * 40,
    b"1e999",
    b"nan",
    b"a/b",
    b"a b",
    b"'\";--",
    b"{}",
    b"[]",
    b"x" * 9000,
    b"",
)
HEADERS = (
    b"Authorization",
    b"Content-Length",
    b"Transfer-Encoding",
    b"Content-Type",
    b"Content-Encoding",
    b"Origin",
    b"Host",
    b"Cookie",
    b"Last-Event-ID",
    b"X-Forwarded-For",
    b"Forwarded",
    b"Upgrade",
    b"Connection",
    b"Expect",
    b"Range",
    b"If-None-Match",
    b"If-Modified-Since",
    b"Sec-WebSocket-Key",
    b"Sec-WebSocket-Version",
    b"Sec-WebSocket-Extensions",
    b"Sec-WebSocket-Protocol",
    b"Accept",
    b"\xff\xfe",
    b"",
    b"A" * 300,
)
VALUES = (
    *NASTY,
    b"Bearer \xff\xfe",
    "Bearer \u00e9".encode(),
    b"Bearer",
    b"bearer  x  y",
    b"Basic dXNlcjpwYXNz",
    b"chunked",
    b"gzip",
    b"deflate, br",
    b"application/json; charset=nothing",
    b"multipart/form-data; boundary=",
    b"http://[::1",
    b"http://evil.example",
    b"null",
    b"websocket",
    b"Upgrade",
    b"100-continue",
    b"bytes=0-,-9999999999999999999999",
    b'W/"x',
    b"permessage-deflate; client_max_window_bits=99",
    b"13",
    b"dGhlIHNhbXBsZSBub25jZQ==",
    b"[",
    b'for="[::1]:99999999"',
)
BODIES = (
    b"",
    b"{}",
    b"[]",
    b"null",
    b"1",
    b"{",
    b"\xff\xfe",
    b'{"a": "\\ud800"}',
    b'{"tag": "\\ud800", "name": "\\u0000"}',
    b'{"userID": "\\udfff", "password": "\\udfff"}',
    b'{"name": "x", "value": 1e999}',
    b'{"name": "x", "value": NaN}',
    b'{"size": 99999999999999999999999999}',
    b"[" * 5000,
    b'{"a":' * 5000,
    b'"' + b"x" * 100_000 + b'"',
    b"5\r\nhello\r\n0\r\n\r\n",
    b"zz\r\nhello\r\n",
    b"\x1f\x8b\x08\x00garbage",
)


def requests(paths: Sequence[str], count: int, headers: Sequence[bytes] = ()) -> Iterator[bytes]:
    """Make raw requests; the same ones each time, but for ``make fuzz``.

    Args:
        paths: Those of the server, with ``{name}`` for their parts.
        count: How many.
        headers: Whole ones that about half of the requests carry, such as a login.
    """
    chance = random.Random(SEED)
    for _ in range(EXAMPLES or count):
        yield _request(chance, chance.choice(paths).encode(), headers)


def _request(chance: random.Random, path: bytes, login: Sequence[bytes]) -> bytes:
    target = re.sub(rb"{\w+}", lambda _: chance.choice(NASTY), path)
    if chance.random() < 0.5:
        pairs = (
            b"=".join((chance.choice(_NAMES), chance.choice(NASTY))) for _ in range(chance.randint(1, 3))
        )
        target += b"?" + b"&".join(pairs)
    lines = [
        b" ".join((_mostly(chance, METHODS[:5], METHODS), target, _mostly(chance, VERSIONS[:1], VERSIONS)))
    ]
    if chance.random() < 0.9:
        lines.append(b"Host: 127.0.0.1")
    if chance.random() < 0.6:
        lines += login
    for _ in range(chance.randint(0, 4)):
        lines.append(chance.choice(HEADERS) + b": " + chance.choice(VALUES))
    body = chance.choice(BODIES)
    if chance.random() < 0.8:
        lines.append(b"Content-Length: %d" % len(body))
    whole = b"\r\n".join(lines) + b"\r\n\r\n" + body
    if chance.random() < 0.2:  # as if it was damaged on its way
        damaged = bytearray(whole)
        for _ in range(chance.randint(1, 8)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        whole = bytes(damaged[: chance.randint(1, len(damaged))])
    return whole


_NAMES = (
    *b"user userID robotID version password name key signature since offset limit stream".split(),
    *b"level life previous interval tag_a tag_b token x %ff".split(),
)


def _mostly(chance: random.Random, usual: Sequence[bytes], other: Sequence[bytes]) -> bytes:
    return chance.choice(usual if chance.random() < 0.8 else other)


async def exchange(port: int, request: bytes, *, whole: bool = False) -> list[int]:
    """Send raw bytes; return the statuses of the answers.

    Args:
        port: Of the server, on this machine.
        request: The bytes.
        whole: They are a whole request, so an answer is waited for. Else the server may be waiting for more:
            when nothing came for a moment the end of the request is sent.
    """
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    answer = b""
    try:
        with contextlib.suppress(ConnectionError):
            writer.write(request)
            answer = await _begin(reader, writer, ANSWER_S if whole else MOMENT_S)
            while not whole and not _is_stream(answer):
                piece = await asyncio.wait_for(reader.read(1 << 16), ANSWER_S)
                if not piece:
                    break
                answer += piece
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()
    return [int(status) for status in _STATUS.findall(answer)]


async def _begin(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, timeout: float) -> bytes:
    """Wait for the beginning of an answer; then, unless it never ends, send the end of the request."""
    answer = b""
    with contextlib.suppress(TimeoutError):
        answer = await asyncio.wait_for(reader.read(1 << 16), timeout)
    if not _is_stream(answer):
        writer.write_eof()
    return answer


def _is_stream(answer: bytes) -> bool:
    return b"text/event-stream" in answer or answer.startswith(b"HTTP/1.1 101 ")


class Tracebacks(logging.Handler):
    """Collects what the log says with a traceback, or as an error."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record."""
        text = logging.Formatter().format(record)
        self.found.append(text)

    @contextlib.contextmanager
    def watching(self) -> Iterator[Tracebacks]:
        """Collect while the context lasts."""
        logging.getLogger().addHandler(self)
        try:
            yield self
        finally:
            logging.getLogger().removeHandler(self)


def answers_of(document: dict[str, Any], url: str, token: str) -> int:
    """Make requests of all operations; return how many were answered as the document says."""
    schema = schemathesis.openapi.from_dict(document)
    headers = {"Authorization": f"Bearer {token}"}
    answered = 0
    for result in schema.get_all_operations():
        assert isinstance(result, Ok), result
        operation = result.ok()
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):

            @seed(SEED)
            @settings(
                max_examples=EXAMPLES // 100 or CASES,
                deadline=None,
                database=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def run(case: schemathesis.Case[Any]) -> None:
                nonlocal answered
                response = case.call(base_url=url, headers=headers, timeout=60)
                case.validate_response(response, checks=CHECKS)
                answered += 1

            run()
    return answered
