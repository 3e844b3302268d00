"""Requests that no application sees: one line in the log if they are not HTTP, and refusals by headers."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from aiohttp import hdrs, web
from aiohttp.http_exceptions import HttpProcessingError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    Handler = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]

request_log = logging.getLogger("rce.web.requests")


_CONTINUE = "100-continue"
_PLAIN = "identity"


def _shorten(record: logging.LogRecord) -> bool:
    """Shorten the library's report of a client's fault to a line; keep everything else as it is."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, (HttpProcessingError, web.RequestPayloadError)):
        # Only the kind of the fault: the rest quotes the request, which may contain a password.
        kind = str(getattr(error, "message", error)).strip().partition(":")[0] or type(error).__name__
        record.msg, record.args = f"{record.getMessage()}: it is not HTTP: %.60r", (kind,)
        record.exc_info = record.exc_text = None
        record.levelno, record.levelname = logging.INFO, "INFO"
    return True


request_log.addFilter(_shorten)


def refuse_headers(handler: Handler) -> Handler:
    """Wrap the handler of requests: refuse those whose headers ask for what no application does.

    The library's answer to an unknown ``Expect`` quotes it, text or not. A compressed body of some kilobytes
    would take seconds of the event loop's time, also after the request was refused.
    """

    async def handle(request: web.BaseRequest) -> web.StreamResponse:
        if request.headers.get(hdrs.EXPECT, _CONTINUE).lower() != _CONTINUE:
            return web.json_response({"error": "the header Expect can only be 100-continue"}, status=417)
        if request.headers.get(hdrs.CONTENT_ENCODING, _PLAIN).lower() != _PLAIN:
            text = "the body must not be compressed: send it without the header Content-Encoding"
            return web.json_response({"error": text}, status=415, headers={hdrs.ACCEPT_ENCODING: _PLAIN})
        return await handler(request)

    return handle
