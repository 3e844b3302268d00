"""The names in a server's own certificate, by which clients may ask for it."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

from rce.tls.faults import CertificateError

if TYPE_CHECKING:
    from rce.tls.identity import TlsIdentity

_WILDCARD = "*"


class CertificateNames:
    """Returns the host names in a server's certificate, as its file is now, without wildcards.

    Args:
        identity: The server's; None for a server without TLS, which has no such names.
    """

    def __init__(self, identity: TlsIdentity | None) -> None:
        self._file = None if identity is None else identity.files.certificate
        self._read_at: object = None
        self._names: frozenset[str] = frozenset()

    def __call__(self) -> frozenset[str]:
        """Return the names in lower case. If a changed file cannot be read, those of before."""
        if self._file is None:
            return frozenset()
        from rce.tls.folder import details_of  # takes 10 MB, which only programs with TLS spend

        try:
            status = self._file.stat()
            signature = status.st_mtime_ns, status.st_size, status.st_ino
            if signature != self._read_at:
                self._names = frozenset(filter(_is_name, map(str.lower, details_of(self._file).hosts)))
                self._read_at = signature
        except (OSError, CertificateError):
            pass  # TlsIdentity reports it
        return self._names


def _is_name(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return _WILDCARD not in host
    return False
