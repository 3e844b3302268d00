"""Decides whether a failed connection attempt is repeated. Pure."""

from __future__ import annotations

import ssl

from websockets.exceptions import InvalidHandshake, InvalidStatus, WebSocketException

from rce.tls import explain_to_client, find_tls_error
from rce_client.exceptions import ClientError, InUseError, RefusedError, UnavailableError, UntrustedError

RETRIED_STATUSES = frozenset((408, 425, 429, 500, 502, 503, 504))
"""HTTP statuses after which another attempt may succeed."""
IN_USE = 409
"""The status if another client has the robotID: perhaps a former connection that has not ended yet."""


def judge_status(status: int, reason: str) -> ClientError:
    """Return the error for an unexpected HTTP answer."""
    if status == IN_USE:
        return InUseError(reason, status)
    if status in RETRIED_STATUSES:
        return UnavailableError(reason, status)
    return RefusedError(status, reason)


def judge(error: Exception) -> ClientError:
    """Return the client error for an exception of a connection attempt.

    Returns:
        :class:`UnavailableError` if another attempt is worth it, else :class:`RefusedError`; a
        :class:`ClientError` is returned as it is.
    """
    if isinstance(error, ClientError):
        return error
    if isinstance(error, InvalidStatus):
        response = error.response
        body = bytes(response.body or b"").decode(errors="replace").strip()
        return judge_status(response.status_code, body or response.reason_phrase)
    if why := explain_to_client(error):
        untrusted = isinstance(find_tls_error(error), ssl.SSLCertVerificationError)
        return UntrustedError(why) if untrusted else UnavailableError(why)
    if isinstance(error, (OSError, EOFError, InvalidHandshake, WebSocketException)):
        late = isinstance(error, TimeoutError)
        return UnavailableError("no answer in time" if late else str(error) or type(error).__name__)
    return RefusedError(0, f"{type(error).__name__}: {error}")
