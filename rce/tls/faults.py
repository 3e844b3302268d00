"""Explanations of failed TLS handshakes, with what to do."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime


class CertificateError(Exception):
    """A certificate or its key cannot be made, read or used; the text says which and what to do."""


_PLAIN = (
    "the server does not speak TLS at this port; remove --tls, or use http:// (ws://), where the network is"
    " trusted, or start the engine with --tls"
)
_FOREIGN = (
    "the server does not trust our certificate: another authority issued it; issue one with the server's"
    " authority (rce certificate issue NAME), and copy it with its key here"
)
_OWN_EXPIRED = (
    "our certificate has expired; renew it where its authority is (rce certificate issue NAME), and copy it"
    " with its key here"
)
_OWN_REVOKED = (
    "our certificate was revoked; if that is an error, issue another one (rce certificate issue NAME), and"
    " copy it with its key here"
)
_AT_CLIENTS = {
    "WRONG_VERSION_NUMBER": _PLAIN,
    "RECORD_LAYER_FAILURE": _PLAIN,
    "HTTP_REQUEST": _PLAIN,
    "TLSV13_ALERT_CERTIFICATE_REQUIRED": "the server demands a certificate of its authority, which task sets"
    " have and robots do not; is this port the right one? For a task set: issue one (rce certificate issue"
    " NAME), copy it with its key and authority.pem here, and start with --tls",
    "TLSV1_ALERT_UNKNOWN_CA": _FOREIGN,
    "TLSV1_ALERT_DECRYPT_ERROR": _FOREIGN,
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": _OWN_EXPIRED,
    "SSLV3_ALERT_CERTIFICATE_REVOKED": _OWN_REVOKED,
    "SSLV3_ALERT_BAD_CERTIFICATE": "the server does not accept our certificate: it may have expired (then"
    " renew it: rce certificate issue NAME), or the machines' clocks differ; the server's log says which",
}
_AT_SERVERS = {
    "HTTP_REQUEST": "it speaks plain HTTP at a TLS port",
    "WRONG_VERSION_NUMBER": "it does not speak TLS",
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "it shows no certificate of the engine's authority",
    "TLSV1_ALERT_UNKNOWN_CA": "it does not trust our certificate: it has another authority, or none",
    "SSLV3_ALERT_BAD_CERTIFICATE": "it does not accept our certificate",
    "SSLV3_ALERT_CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": _OWN_EXPIRED,
    "SSLV3_ALERT_CERTIFICATE_REVOKED": _OWN_REVOKED,
    "CERTIFICATE_VERIFY_FAILED": "its certificate is not one of the engine's authority",
}
_BAD_AT_SERVERS = {
    "certificate has expired": "its certificate has expired; renew it: rce certificate issue NAME",
    "certificate revoked": "its certificate was revoked",
    "certificate is not yet valid": "its certificate is not yet valid; look at the clocks of both machines",
}
_DEPTH = 5


def find_tls_error(error: BaseException | None) -> ssl.SSLError | None:
    """Return the TLS error that an error is, or was raised for."""
    for _ in range(_DEPTH):
        if error is None:
            return None
        further = error.__cause__ or error.__context__
        # Some errors of aiohttp inherit from ssl's without their attributes, but were raised from one.
        if isinstance(error, ssl.SSLError) and (hasattr(error, "reason") or further is None):
            return error
        error = further
    return None


def explain_to_client(error: BaseException) -> str | None:
    """Return why the connection to a server failed; None if TLS is not the reason."""
    found = find_tls_error(error)
    if isinstance(found, ssl.SSLCertVerificationError):
        return _explain_server(getattr(found, "verify_message", str(found)))
    if found is None:
        return None
    reason = getattr(found, "reason", "")
    return _AT_CLIENTS.get(reason, f"TLS failed: {reason or found}")


def _explain_server(said: str) -> str:
    """Return the fault of a server's certificate, from OpenSSL's error."""
    if "expired" in said:
        return (
            "the server's certificate has expired; renew it there: rce certificate issue NAME"
            f" (the clock here says {_clock()})"
        )
    if "not yet valid" in said:
        return (
            f"the server's certificate is not yet valid: the clock here says {_clock()}; set the clock of"
            " this machine, or that of the machine that issued the certificate"
        )
    if "revoked" in said:
        return "the server's certificate was revoked; issue it again there: rce certificate issue NAME"
    if "not valid for" in said or "mismatch" in said.lower():
        return (
            f"the server's certificate is for another name ({said.rstrip('.')});"
            " issue it with that name: rce certificate issue NAME --host HOST"
        )
    return (
        f"the server's certificate is not trusted ({said}); give its engine's authority.pem:"
        " --authority FILE, or to task sets --certificates FOLDER"
    )


def _clock() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"


def explain_to_server(error: BaseException) -> str:
    """Return why a client was refused."""
    found = find_tls_error(error)
    if found is None:
        if isinstance(error, ConnectionError):
            return "it hung up during the handshake; it may not trust our certificate"
        return str(error) or type(error).__name__
    reason = getattr(found, "reason", "")
    text = _AT_SERVERS.get(reason, f"TLS failed: {reason or found}")
    if isinstance(found, ssl.SSLCertVerificationError):
        said = getattr(found, "verify_message", str(found))
        return _BAD_AT_SERVERS.get(said, f"{text} ({said})")
    return text
