"""The folder ``certificates/`` with an engine's authority and its certificates.

It holds ``authority.pem``, ``authority.key``, and ``NAME.pem`` with ``NAME.key`` for each name; beside them
what was issued and what was revoked (:mod:`rce.tls.revocation`). Only its owner may enter it. A machine that
issues nothing has no ``authority.key``.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

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
from rce.tls.faults import CertificateError
from rce.tls.revocation import Record, Revocation, make_list, read_list

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

AUTHORITY = "authority"
REVOKED = "revoked"
"""Name of the file with the list of revoked certificates, without its suffix."""
_KEPT_NAMES = AUTHORITY, REVOKED
_RECORDS = "issued.jsonl"
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

    @property
    def revoked(self) -> Path:
        """The list of revoked certificates; may be missing before the first revocation."""
        return self.certificate(REVOKED)

    def has(self, name: str) -> bool:
        """Return whether a certificate and its key are there."""
        return self.certificate(name).exists() and self.key(name).exists()

    def make_authority(self, days: float = AUTHORITY_DAYS) -> None:
        """Make the authority.

        Raises:
            CertificateError: There is one already, or the folder cannot be written.
        """
        made = make_authority(days)
        with self._locked():
            if self.authority.exists() or (self.key(AUTHORITY).exists() and self._has_issued()):
                raise CertificateError(
                    f"there is an authority in {self.path} already; all certificates that it issued depend on"
                    " it"
                )
            self._write(AUTHORITY, made)
            for file in (self.revoked, self.path / _RECORDS):  # of a former authority
                file.unlink(missing_ok=True)

    def _has_issued(self) -> bool:
        """Whether a certificate depends on the key: none does if only the authority's certificate is missing.

        A program that was killed between both files of the authority left the key alone.
        """
        return (self.path / _RECORDS).exists() or any(self.path.glob("*.pem"))

    def issue(self, name: str, hosts: Iterable[str] = (), days: float = CERTIFICATE_DAYS) -> Details:
        """Issue a certificate, or renew it: programs that run load the new one by themselves.

        Args:
            name: Its owner; also the name of its files.
            hosts: Names and IP addresses that it is good for. If empty, those of the certificate that it
                replaces, or else its own name.
            days: How long it is valid.

        Returns:
            The contents of the certificate.

        Raises:
            CertificateError: The name cannot be used, no authority is here, or a file cannot be written.
        """
        hosts, named = tuple(hosts), None
        if not hosts:
            with contextlib.suppress(CertificateError):
                hosts, named = (former := self.details(name)).hosts, self._named(former)
        return self._issue(name, hosts or (name,), named, days)

    def _issue(
        self, name: str, hosts: tuple[str, ...], named: tuple[str, ...] | None, days: float = CERTIFICATE_DAYS
    ) -> Details:
        """Issue a certificate.

        Args:
            name: Its owner.
            hosts: What it is good for.
            named: Those of them that an operator named; None: all.
            days: How long it is valid.
        """
        if not _NAME.fullmatch(name) or name in _KEPT_NAMES:
            raise CertificateError(
                f"{name!r} cannot be a certificate's name: use up to 63 letters, digits, '.', '_' and '-',"
                f" and not {' or '.join(map(repr, _KEPT_NAMES))}"
            )
        self._need_authority()
        issued = issue(self._authority(), name, hosts, days)
        with self._locked():
            self._record(name, read_details(issued.certificate), named)
            self._write(name, issued)
        return self.details(name)

    def _named(self, issued: Details) -> tuple[str, ...] | None:
        """Return the hosts of a certificate that an operator named; None: all."""
        return next((one.named for one in self._records() if int(one.serial, 16) == issued.serial), None)

    def revoke(self, name: str) -> list[Revocation]:
        """Revoke all certificates of a name; programs that check the list load it by themselves.

        Returns:
            Those that were not revoked before.

        Raises:
            CertificateError: The name has no certificate here, no authority is here, or a file cannot be read
                or written.
        """
        self._need_authority()
        serials = {int(record.serial, 16) for record in self._records() if record.name == name}
        if name not in _KEPT_NAMES and self.certificate(name).exists():
            if not is_signed_by(_read(self.certificate(name)), _read(self.authority)):
                raise CertificateError(
                    f"another authority issued {self.certificate(name)}: revoke it where that authority is"
                )
            serials.add(self.details(name).serial)
        if not serials:
            raise CertificateError(
                f"no certificate {name!r} was issued in {self.path}; see: rce certificate list"
            )
        with self._locked():
            known = self.revocations()
            now = datetime.now(UTC)
            added = [Revocation(serial, now) for serial in sorted(serials - {one.serial for one in known})]
            if added:
                self._write_list([*known, *added])
        return added

    def ensure_list(self) -> None:
        """Write an empty list of revoked certificates if there is none, for programs that need the file.

        Raises:
            CertificateError: No authority is here, or the file cannot be written.
        """
        self._need_authority()
        with self._locked():
            if not self.revoked.exists():
                self._write_list([])

    def _write_list(self, revoked: list[Revocation]) -> None:
        text = make_list(self._authority(), revoked)
        with self._writing():
            _write_private(self.revoked, text)

    def revocations(self) -> list[Revocation]:
        """Return the revocations, oldest first.

        Raises:
            CertificateError: The list cannot be read.
        """
        if not self.revoked.exists():
            return []
        try:
            return read_list(_read(self.revoked), _read(self.authority))
        except CertificateError as error:
            raise CertificateError(f"{self.revoked}: {error}") from error

    def owners(self) -> dict[int, str]:
        """Return the names of all certificates that were issued here and have not expired, by serial number.

        Raises:
            CertificateError: The record cannot be read.
        """
        return {int(record.serial, 16): record.name for record in self._records()}

    def ensure(self, name: str, hosts: Iterable[str]) -> str:
        """Make or renew the authority and a certificate that is valid for ``hosts``, if needed.

        A renewal keeps the hosts that an operator named, and of the others only those that are asked for: a
        machine gets new addresses again and again.

        Returns:
            What was done, in words; empty if nothing.

        Raises:
            CertificateError: They cannot be made, or read.
        """
        wanted = tuple(dict.fromkeys(hosts))
        if not self.authority.exists():
            self.make_authority()
            self._issue(name, wanted, ())
            return f"made an authority and the certificate {name} in {self.path}"
        if not self.has(name):
            self._issue(name, wanted, ())
            return f"issued the certificate {name} in {self.path}"
        found = self.details(name)
        missing = [host for host in wanted if not found.covers(host)]
        revoked = any(one.serial == found.serial for one in self.revocations())
        if found.days_left() > RENEWAL_DAYS and not missing and not revoked:
            return ""
        if not self.key(AUTHORITY).exists() or not is_signed_by(
            _read(self.certificate(name)), _read(self.authority)
        ):
            return ""  # it was issued elsewhere, so it is renewed there; the master warns when it is time
        named = self._named(found)
        kept = found if named is None else replace(found, hosts=named)
        self._issue(name, (*kept.hosts, *(host for host in wanted if not kept.covers(host))), kept.hosts)
        why = f"for {', '.join(missing)}" if missing else "before it expires"
        if revoked:
            why = "because it was revoked"
        return f"renewed the certificate {name} {why}"

    def details(self, name: str) -> Details:
        """Read a certificate.

        Raises:
            CertificateError: It cannot be read.
        """
        return details_of(self.certificate(name))

    def all(self) -> Iterator[tuple[str, Details | str]]:
        """Yield the names of all certificates with their contents, or why they cannot be read."""
        for file in sorted(self.path.glob("*.pem")):
            if file == self.revoked:
                continue
            try:
                yield file.stem, self.details(file.stem)
            except CertificateError as error:
                yield file.stem, str(error)

    def _need_authority(self) -> None:
        if not self.has(AUTHORITY):
            raise CertificateError(
                f"there is no authority with its key in {self.path}; make one: rce certificate init"
            )

    def _authority(self) -> Issued:
        return Issued(_read(self.authority), _read(self.key(AUTHORITY)))

    def _records(self) -> list[Record]:
        file = self.path / _RECORDS
        if not file.exists():
            return []
        try:
            return [_DECODER.decode(line) for line in _read(file).splitlines() if line]
        except msgspec.MsgspecError as error:
            raise CertificateError(f"{file}: {error}; remove the damaged line") from error

    def _record(self, name: str, issued: Details, named: tuple[str, ...] | None) -> None:
        """Record a certificate before it is handed out, and remove expired ones from the record."""
        now = datetime.now(UTC)
        kept = [record for record in self._records() if record.expires > now]
        kept.append(Record(name, f"{issued.serial:x}", issued.expires, named))
        with self._writing():
            text = b"".join(msgspec.json.encode(record) + b"\n" for record in kept)
            _write_private(self.path / _RECORDS, text)

    def _write(self, name: str, issued: Issued) -> None:
        with self._writing():
            # A program that reads between the two writes finds a wrong pair, and keeps the old one.
            _write_private(self.key(name), issued.key)
            _write_private(self.certificate(name), issued.certificate)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Wait for other programs that issue or revoke here: what one has recorded must not be lost."""
        with self._writing():
            folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                fcntl.flock(folder, fcntl.LOCK_EX)
                yield
            finally:
                os.close(folder)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            self.path.mkdir(mode=stat.S_IRWXU, parents=True, exist_ok=True)
            self.path.chmod(stat.S_IRWXU)
            yield
        except OSError as error:
            raise CertificateError(f"cannot write to {self.path}: {error}") from error


_DECODER = msgspec.json.Decoder(Record)


def details_of(file: Path) -> Details:
    """Read a certificate's file.

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
    """Write a file atomically that only its owner may read; it is whole also after a loss of power.

    A file that is replaced keeps its owner: services run as a user of their own, and root renews for them.
    """
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    aside.unlink(missing_ok=True)
    try:
        descriptor = os.open(aside, flags, 0o600)
        with os.fdopen(descriptor, "wb") as output:
            output.write(content)
            output.flush()
            os.fsync(descriptor)
            if os.geteuid() == 0 and (owner := _owner_of(file)) is not None:
                os.fchown(descriptor, *owner)
        aside.replace(file)
    finally:
        aside.unlink(missing_ok=True)


def _owner_of(file: Path) -> tuple[int, int] | None:
    """Return the user and group of a file; for a new list of revoked ones, those who read it, of the folder.

    Other new files are keys of other machines, or the authority's, and stay those of this process.
    """
    with contextlib.suppress(FileNotFoundError):
        was = file.lstat()
        return was.st_uid, was.st_gid
    if file.stem != REVOKED:
        return None
    folder = file.parent.stat()
    return folder.st_uid, folder.st_gid
