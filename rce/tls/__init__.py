"""TLS for every connection of the engine: certificates, contexts, and servers that answer in TLS."""

from rce.tls.faults import CertificateError, explain_to_client, find_tls_error
from rce.tls.identity import Context, client_context, client_contexts

__all__ = [
    "CertificateError",
    "Context",
    "client_context",
    "client_contexts",
    "explain_to_client",
    "find_tls_error",
]
