"""What a failed TLS handshake means, in words that say what to do."""

from __future__ import annotations

import ssl

_AT_CLIENTS = {
    "WRONG_VERSION_NUMBER": "the server does not speak TLS at this port; start the engine with --tls,"
    " or use http:// where the network is trusted",
    "RECORD_LAYER_FAILURE": "the server does not speak TLS at this port; start the engine with --tls,"
    " or use http:// where the network is trusted",
    "TLSV13_ALERT_CERTIFICATE_REQUIRED": "the server demands a certificate of its authority;"
    " issue one (rce certificate issue NAME), copy it with its key and authority.pem here, start with --tls",
    "TLSV1_ALERT_UNKNOWN_CA": "the server does not trust our certificate: another authority issued it;"
    " issue one with the server's authority (rce certificate issue NAME)",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": "our certificate has expired; renew it: rce certificate issue NAME",
    "TLSV1_ALERT_DECRYPT_ERROR": "the server does not trust our certificate: another authority issued it",
}
_AT_SERVERS = {
    "HTTP_REQUEST": "it speaks plain HTTP at a TLS port",
    "WRONG_VERSION_NUMBER": "it does not speak TLS",
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "it shows no certificate of the engine's authority",
    "TLSV1_ALERT_UNKNOWN_CA": "it does not trust our certificate: it has another authority, or none",
    "SSLV3_ALERT_BAD_CERTIFICATE": "it does not accept our certificate",
    "SSLV3_ALERT_CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": "our certificate has expired; renew it: rce certificate issue NAME",
    "CERTIFICATE_VERIFY_FAILED": "its certificate is not one of the engine's authority",
}
_DEPTH = 5


def find_tls_error(error: BaseException | None) -> ssl.SSLError | None:
    """Return the TLS error that an error is, or was raised for."""
    for _ in range(_DEPTH):
        if error is None:
            return None
        further = error.__cause__ or error.__context__
        # aiohttp has errors that inherit from ssl's and hold nothing of theirs, but were raised from one.
        if isinstance(error, ssl.SSLError) and (hasattr(error, "reason") or further is None):
            return error
        error = further
    return None


def explain_to_client(error: BaseException) -> str | None:
    """Say why a server cannot be talked to; None if TLS is not the reason."""
    found = find_tls_error(error)
    if isinstance(found, ssl.SSLCertVerificationError):
        said = getattr(found, "verify_message", str(found))
        if "expired" in said:
            return "the server's certificate has expired; renew it there: rce certificate issue NAME"
        if "not valid for" in said or "mismatch" in said.lower():
            return (
                f"the server's certificate is for another name ({said.rstrip('.')});"
                " issue it with that name: rce certificate issue NAME --host HOST"
            )
        return (
            f"the server's certificate is not trusted ({said}); give its engine's authority.pem:"
            " --authority FILE, or to task sets --certificates FOLDER"
        )
    if found is None:
        return None
    reason = getattr(found, "reason", "")
    return _AT_CLIENTS.get(reason, f"TLS failed: {reason or found}")


def explain_to_server(error: BaseException) -> str:
    """Say why a client was not taken."""
    found = find_tls_error(error)
    if found is None:
        if isinstance(error, ConnectionError):
            return "it hung up during the handshake; it may not trust our certificate"
        return str(error) or type(error).__name__
    reason = getattr(found, "reason", "")
    text = _AT_SERVERS.get(reason, f"TLS failed: {reason or found}")
    if isinstance(found, ssl.SSLCertVerificationError):
        return f"{text} ({getattr(found, 'verify_message', found)})"
    return text
