"""The folder ``certificates/`` with an engine's authority and what it has issued.

It holds ``authority.pem``, ``authority.key``, and ``NAME.pem`` with ``NAME.key`` for each name. Only its
owner may enter it. A machine that issues nothing has no ``authority.key``.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rce.tls.authority import (
    AUTHORITY_DAYS,
    CERTIFICATE_DAYS,
    RENEWAL_DAYS,
    Details,
    Issued,
    is_signed_by,
    issue,
    make_authority,
    read_details,
)
from rce.tls.exceptions import CertificateError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

AUTHORITY = "authority"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,62}")


@dataclass(frozen=True, slots=True)
class CertificateFolder:
    """A folder with certificates."""

    path: Path

    def certificate(self, name: str) -> Path:
        """Return the file of a certificate."""
        return self.path / f"{name}.pem"

    def key(self, name: str) -> Path:
        """Return the file of its key."""
        return self.path / f"{name}.key"

    @property
    def authority(self) -> Path:
        """The authority's certificate, which clients need."""
        return self.certificate(AUTHORITY)

    def has(self, name: str) -> bool:
        """Tell whether a certificate and its key are there."""
        return self.certificate(name).exists() and self.key(name).exists()

    def make_authority(self, days: float = AUTHORITY_DAYS) -> None:
        """Make the authority.

        Raises:
            CertificateError: There is one already, or the folder cannot be written.
        """
        if self.authority.exists() or self.key(AUTHORITY).exists():
            raise CertificateError(
                f"there is an authority in {self.path} already; all certificates that it issued depend on it"
            )
        self._write(AUTHORITY, make_authority(days))

    def issue(self, name: str, hosts: Iterable[str] = (), days: float = CERTIFICATE_DAYS) -> Details:
        """Issue a certificate, or renew it: programs that run load the new one by themselves.

        Args:
            name: Whose it is; the name of its files.
            hosts: Names and IP addresses that it is good for. If empty, those of the certificate that it
                replaces, or else its own name.
            days: How long it is valid.

        Returns:
            What it says.

        Raises:
            CertificateError: The name cannot be used, no authority is here, or a file cannot be written.
        """
        if not _NAME.fullmatch(name) or name == AUTHORITY:
            raise CertificateError(
                f"{name!r} cannot be a certificate's name: use up to 63 letters, digits, '.', '_' and '-',"
                f" and not {AUTHORITY!r}"
            )
        if not self.has(AUTHORITY):
            raise CertificateError(
                f"there is no authority with its key in {self.path}; make one: rce certificate init"
            )
        hosts = tuple(hosts)
        if not hosts:
            with contextlib.suppress(CertificateError):
                hosts = self.details(name).hosts
        if not hosts:
            hosts = (name,)
        authority = Issued(_read(self.authority), _read(self.key(AUTHORITY)))
        self._write(name, issue(authority, name, hosts, days))
        return self.details(name)

    def ensure(self, name: str, hosts: Iterable[str]) -> str:
        """Have an authority and a certificate that is good for ``hosts`` and not about to expire.

        Returns:
            What was done, in words; empty if nothing.

        Raises:
            CertificateError: They cannot be made, or read.
        """
        wanted = tuple(dict.fromkeys(hosts))
        if not self.authority.exists():
            self.make_authority()
            self.issue(name, wanted)
            return f"made an authority and the certificate {name} in {self.path}"
        if not self.has(name):
            self.issue(name, wanted)
            return f"issued the certificate {name} in {self.path}"
        found = self.details(name)
        missing = [host for host in wanted if not found.covers(host)]
        if found.days_left() > RENEWAL_DAYS and not missing:
            return ""
        if not self.key(AUTHORITY).exists() or not is_signed_by(
            _read(self.certificate(name)), _read(self.authority)
        ):
            return ""  # it was issued elsewhere, so it is renewed there; the master warns when it is time
        self.issue(name, (*found.hosts, *missing))
        why = f"for {', '.join(missing)}" if missing else "before it expires"
        return f"renewed the certificate {name} {why}"

    def details(self, name: str) -> Details:
        """Read what a certificate says.

        Raises:
            CertificateError: It cannot be read.
        """
        return details_of(self.certificate(name))

    def all(self) -> Iterator[tuple[str, Details | str]]:
        """Yield the names of all certificates with what they say, or why they cannot be read."""
        for file in sorted(self.path.glob("*.pem")):
            try:
                yield file.stem, self.details(file.stem)
            except CertificateError as error:
                yield file.stem, str(error)

    def _write(self, name: str, issued: Issued) -> None:
        try:
            self.path.mkdir(mode=stat.S_IRWXU, parents=True, exist_ok=True)
            self.path.chmod(stat.S_IRWXU)
            # A program that looks between the two finds a pair that does not fit, and keeps the old one.
            _write_private(self.key(name), issued.key)
            _write_private(self.certificate(name), issued.certificate)
        except OSError as error:
            raise CertificateError(f"cannot write to {self.path}: {error}") from error


def details_of(file: Path) -> Details:
    """Read what a certificate's file says.

    Raises:
        CertificateError: It cannot be read.
    """
    try:
        return read_details(_read(file))
    except CertificateError as error:
        raise CertificateError(f"{file}: {error}") from error


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CertificateError(f"cannot read {file}: {error.strerror or error}") from error


def _write_private(file: Path, content: bytes) -> None:
    """Write a file that only its owner may read; it appears whole or not at all."""
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as output:
            output.write(content)
        aside.replace(file)
    finally:
        aside.unlink(missing_ok=True)
