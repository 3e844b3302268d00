"""Warn of certificates that expire soon, or that are not valid for the name that clients use."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce.tls.faults import CertificateError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from rce.tls.authority import Details
    from rce.tls.identity import TlsFiles, TlsIdentity

_log = logging.getLogger(__name__)

CHECK_EVERY_S = 6 * 3600.0
"""How often certificates are checked."""


async def watch_expiry(files: Iterable[TlsFiles], every: float = CHECK_EVERY_S) -> None:
    """Log a warning for each certificate that is to be renewed, again and again, until cancelled."""
    watched = dict.fromkeys(
        path for one in files for path in (one.certificate, one.authority) if path is not None
    )
    while True:
        for path in watched:
            if text := expiry_warning(path):
                _log.warning("%s", text)
        await asyncio.sleep(every)


def expiry_warning(certificate: Path) -> str | None:
    """Return the warning for a certificate; None if it need not be renewed."""
    from rce.tls.authority import RENEWAL_DAYS

    details = _details(certificate)
    if isinstance(details, str):
        return details
    left = details.days_left()
    if left > RENEWAL_DAYS:
        return None
    state = f"expires in {left:.0f} days" if left > 0 else "has expired"
    if details.is_authority:
        return f"the authority {certificate} {state}: make a new one (docs/how-to/tls.md)"
    return (
        f"the certificate {certificate} {state}: renew it where its authority is"
        f" (rce certificate issue {certificate.stem}); programs load the new one without a restart"
    )


def name_warning(identity: TlsIdentity, host: str) -> str | None:
    """Return a warning if a server's certificate is not valid for the name that clients use."""
    certificate = identity.files.certificate
    assert certificate is not None
    details = _details(certificate)
    if isinstance(details, str):
        return details
    if details.covers(host):
        return None
    return (
        f"clients are sent to {host}, but the certificate {certificate} is for"
        f" {', '.join(details.hosts) or 'no host'}: issue it again with --host {host}, or set --public-host"
    )


def _details(certificate: Path) -> Details | str:
    from rce.tls.folder import details_of  # takes 10 MB, which only programs with TLS spend

    try:
        return details_of(certificate)
    except CertificateError as error:
        return str(error)
