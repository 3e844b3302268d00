"""The certificates that a program uses, by the options ``--tls``, ``--certificates``, ..."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.config import EngineSettings, default_state_dir
from rce.tls.faults import CertificateError
from rce.tls.identity import TlsFiles, TlsIdentity

if TYPE_CHECKING:
    from pathlib import Path


ENGINE = "engine"
"""Name of the certificate that an engine's programs use by default."""
FOLDER = "certificates"
BETWEEN_TASK_SETS = "messages between task sets, and their secret, travel"
"""What is sent in clear where only clients have TLS."""
WARNED_VARIABLE = "RCE_TLS_WARNED"
"""Set for programs whose starter has warned already."""


def default_folder() -> Path:
    """Return the default folder of certificates."""
    return default_state_dir() / FOLDER


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsChoice:
    """A program's settings of TLS."""

    enabled: bool = False
    """Use TLS everywhere, with certificates of the engine's own authority."""
    folder: Path = field(default_factory=default_folder)
    name: str = ENGINE
    certificate: Path | None = None
    """Show clients this certificate, of a public authority for example; alone it gives TLS to them only."""
    key: Path | None = None

    @classmethod
    def of(cls, settings: EngineSettings) -> TlsChoice:
        """Read it from the engine's settings."""
        tls = settings.tls
        return cls(
            enabled=tls.enabled,
            folder=settings.certificates,
            name=tls.name,
            certificate=tls.cert,
            key=tls.key,
        )

    def for_clients(self) -> TlsIdentity | None:
        """Return the identity of a server for clients, robots and browsers; None for a plain one.

        Raises:
            CertificateError: The files cannot be used.
        """
        if self.certificate is None:
            if self.key is not None:
                raise CertificateError("a TLS key needs its certificate: give --tls-cert too")
            identity = TlsIdentity(self._own()) if self.enabled else None
        else:
            identity = TlsIdentity(TlsFiles(certificate=self.certificate, key=self.key))
        if identity is not None:
            identity.server()
        return identity

    def for_task_sets(self) -> TlsIdentity | None:
        """Return the identity of task sets for each other; None for plain connections.

        Raises:
            CertificateError: The files cannot be used.
        """
        if not self.enabled:
            return None
        identity = TlsIdentity(self._own())
        identity.mutual_server()
        return identity

    def own_identity(self) -> TlsIdentity:
        """Return this machine's identity by the engine's authority, also where TLS is not used elsewhere.

        Raises:
            CertificateError: The files cannot be used.
        """
        identity = TlsIdentity(self._own())
        identity.client()
        return identity

    def plain_warning(self, to_clients: str, *hosts: str) -> str | None:
        """Return the warning of a program that serves other machines without TLS; None if it does not.

        Args:
            to_clients: The data that is sent in clear if clients have no TLS either; empty: none.
            hosts: The addresses that it listens on.
        """
        if self.enabled:
            return None
        clients_too = to_clients and self.certificate is None
        return plain_warning(to_clients if clients_too else BETWEEN_TASK_SETS, *hosts)

    def _own(self) -> TlsFiles:
        certificate, key = self.folder / f"{self.name}.pem", self.folder / f"{self.name}.key"
        return TlsFiles(certificate, key, self.folder / "authority.pem", self.folder / "revoked.pem")


def plain_warning(what: str, *hosts: str) -> str | None:
    """Return the warning of a program that serves other machines without TLS; None if it does not.

    Args:
        what: The data that is sent in clear.
        hosts: The addresses that it listens on without TLS.
    """
    open_ones = [host or "all addresses" for host in hosts if not is_loopback(host)]
    if not open_ones or os.environ.get(WARNED_VARIABLE):
        return None
    where = ", ".join(dict.fromkeys(open_ones))
    return f"{what} in clear: this listens on {where} without TLS; start it with --tls (docs/how-to/tls.md)"


def is_loopback(host: str) -> bool:
    """Return whether an address is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
