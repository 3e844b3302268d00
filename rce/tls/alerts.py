"""Make a TLS server send the reason when a handshake fails.

OpenSSL writes an alert for the client when a handshake fails. asyncio and uvloop drop it with the connection,
so that the client sees a hang-up only. A context of this module keeps the alert in the error, for
:class:`rce.tls.gate.TlsGate` to send.
"""

from __future__ import annotations

import ssl
from typing import Any


class AlertingContext(ssl.SSLContext):
    """A server's context whose failed handshakes raise errors that hold the alert (:func:`alert_of`)."""

    def wrap_bio(self, incoming: ssl.MemoryBIO, outgoing: ssl.MemoryBIO, *args: Any, **options: Any) -> Any:
        """Make a connection's TLS object, as event loops do."""
        made = super().wrap_bio(incoming, outgoing, *args, **options)
        assert isinstance(made, _AlertingObject)
        made.outgoing = outgoing
        return made


class _AlertingObject(ssl.SSLObject):
    outgoing: ssl.MemoryBIO | None = None

    def do_handshake(self) -> None:
        try:
            super().do_handshake()
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
            raise
        except ssl.SSLError as error:
            if self.outgoing is not None:
                error.alert = self.outgoing.read()  # type: ignore[attr-defined] # for alert_of alone
            raise


AlertingContext.sslobject_class = _AlertingObject


def alert_of(error: BaseException | None) -> bytes:
    """Return the alert that OpenSSL wrote when a handshake failed; empty if it wrote none."""
    found = getattr(error, "alert", b"")
    return found if isinstance(found, bytes) else b""
