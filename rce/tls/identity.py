"""A program's certificate as TLS contexts, which follow the files: a renewed certificate needs no restart."""

from __future__ import annotations

import logging
import os
import ssl
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from rce.tls.alerts import AlertingContext
from rce.tls.faults import CertificateError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_log = logging.getLogger(__name__)

Context: TypeAlias = "Callable[[], ssl.SSLContext]"
"""Gives the context for the next connection."""
_Signature: TypeAlias = "tuple[tuple[int, int, int] | None, ...]"


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """The files of one end. Each is optional where its use allows it."""

    certificate: Path | None = None
    key: Path | None = None
    authority: Path | None = None
    """The authority of the other end's certificate; the system's authorities if None."""
    revoked: Path | None = None
    """The authority's list of certificates that it has revoked; the file may be missing."""


class TlsIdentity:
    """Makes contexts from files, and makes them again when the files have changed.

    The files are checked when a connection begins. If new ones cannot be used, that is logged once, and the
    last valid ones stay in use.

    Args:
        files: The files.

    Example::

        identity = TlsIdentity(TlsFiles(certificate, key, authority))
        reader, writer = await asyncio.open_connection(host, port, ssl=identity.client())
    """

    def __init__(self, files: TlsFiles) -> None:
        self.files = files
        self._contexts: dict[str, tuple[_Signature, ssl.SSLContext]] = {}
        self._bad: dict[str, _Signature] = {}
        self._serials: frozenset[int] = frozenset()
        self._serials_of: object = None
        self._bad_serials: object = ()

    def server(self) -> ssl.SSLContext:
        """Return the context of a server that asks clients for no certificate.

        Raises:
            CertificateError: The files cannot be used, and never could.
        """
        return self._get("server", self._make_server)

    def mutual_server(self) -> ssl.SSLContext:
        """Return the context of a server that demands a certificate of the authority.

        Raises:
            CertificateError: The files cannot be used, and never could.
        """
        return self._get("mutual", self._make_mutual)

    def client(self) -> ssl.SSLContext:
        """Return the context of a client; it shows the certificate if there is one.

        Raises:
            CertificateError: The files cannot be used, and never could.
        """
        return self._get("client", self._make_client)

    def is_revoked(self, serial: int) -> bool:
        """Return whether the authority has revoked a certificate. For established connections.

        Args:
            serial: Of the certificate.
        """
        files = self.files
        stamp = None if files.revoked is None else _stamp(files.revoked)
        if stamp != self._serials_of and files.revoked is not None and files.authority is not None:
            try:
                self._serials = _revoked_serials(files.revoked, files.authority)
                self._serials_of = stamp
            except OSError as error:  # it is read again, by the next call
                self._warn_of_serials(stamp, error)
            except CertificateError as error:
                self._serials_of = stamp
                self._warn_of_serials(stamp, error)
        return serial in self._serials

    def _warn_of_serials(self, stamp: object, error: Exception) -> None:
        if self._bad_serials != stamp:
            self._bad_serials = stamp
            _log.warning("the former list of revoked certificates stays in use: %s", error)

    def _get(self, role: str, make: Callable[[], ssl.SSLContext]) -> ssl.SSLContext:
        now = self._signature()
        signature, context = self._contexts.get(role, (None, None))
        if context is not None and signature == now:
            return context
        try:
            made = make()
        except CertificateError as error:
            if context is None:
                raise
            if self._bad.get(role) != now:
                self._bad[role] = now
                _log.warning("the former certificate stays in use: %s", error)
            return context
        if context is not None:
            _log.info("loaded the changed certificate %s", self.files.certificate or self.files.authority)
        self._contexts[role] = now, made
        return made

    def _signature(self) -> _Signature:
        files = self.files
        return tuple(_stamp(file) for file in (files.certificate, files.key, files.authority, files.revoked))

    def _make_server(self) -> ssl.SSLContext:
        context = AlertingContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        self._load_certificate(context)
        return context

    def _make_mutual(self) -> ssl.SSLContext:
        context = self._make_server()
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.verify_mode = ssl.CERT_REQUIRED
        self._trust(context)
        return context

    def _make_client(self) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        self._trust(context)
        if self.files.certificate is not None:
            self._load_certificate(context)
        return context

    def _trust(self, context: ssl.SSLContext) -> None:
        authority = self.files.authority
        if authority is None:
            context.load_default_certs()
            return
        try:
            context.load_verify_locations(authority)
        except (OSError, ssl.SSLError) as error:
            if isinstance(error, PermissionError):
                raise CertificateError(f"the authority {authority} {_why_unreadable(authority)}") from error
            raise CertificateError(
                f"cannot use the authority {authority}: {_reason(error)};"
                " copy authority.pem from the engine's certificates folder"
            ) from error
        self._refuse_revoked(context, authority)

    def _refuse_revoked(self, context: ssl.SSLContext, authority: Path) -> None:
        revoked = self.files.revoked
        if revoked is None:
            return
        try:
            if not _revoked_serials(revoked, authority):
                return
            context.load_verify_locations(revoked)
        except (OSError, CertificateError) as error:
            why = _reason(error) if isinstance(error, OSError) else error
            raise CertificateError(f"cannot use the list of revoked certificates {revoked}: {why}") from error
        context.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF

    def _load_certificate(self, context: ssl.SSLContext) -> None:
        certificate, key = self.files.certificate, self.files.key
        if certificate is None:
            raise CertificateError("a TLS server needs a certificate; make one: rce certificate issue NAME")
        try:
            context.load_cert_chain(certificate, key, _no_password)
        except (OSError, ssl.SSLError) as error:
            for file in (certificate, key):
                if file is not None and (why := _why_unreadable(file)):
                    raise CertificateError(f"{file} {why}") from error
            raise CertificateError(f"cannot use the certificate {certificate}: {_reason(error)}") from error


def client_context(authority: Path | None) -> ssl.SSLContext | None:
    """Return a client's context that trusts one authority only; None, which means the system's, without one.

    Raises:
        CertificateError: The authority cannot be used.
    """
    contexts = client_contexts(authority)
    return None if contexts is None else contexts()


def client_contexts(authority: Path | None) -> Context | None:
    """Return a function that returns a client's context for each connection, by the present authority's file.

    Raises:
        CertificateError: The authority cannot be used.
    """
    if authority is None:
        return None
    contexts = TlsIdentity(TlsFiles(authority=authority)).client
    contexts()
    return contexts


def _no_password() -> str:
    """Keep OpenSSL from asking at the terminal for the password of an encrypted key."""
    return ""


def _stamp(file: Path | None) -> tuple[int, int, int] | None:
    if file is None:
        return None
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def _revoked_serials(revoked: Path, authority: Path) -> frozenset[int]:
    """Read a list of revoked certificates, which may be missing.

    Raises:
        OSError: It cannot be read.
        CertificateError: It is damaged, or the authority did not sign it.
    """
    try:
        signed = revoked.read_bytes()
    except FileNotFoundError:
        return frozenset()
    from rce.tls.revocation import read_list  # takes 10 MB, which only engines with a list spend

    return frozenset(one.serial for one in read_list(signed, authority.read_bytes()))


def _why_unreadable(file: Path) -> str:
    """Return why a file cannot be read, and what to do; empty if it can be, or for another reason."""
    try:
        file.open("rb").close()
    except FileNotFoundError:
        folder = file.parent
        return (
            f"does not exist; make it (rce certificate issue NAME --certificates {folder})"
            " or copy it from the engine"
        )
    except PermissionError:
        user = os.geteuid()
        return (
            f"may not be read by this program's user ({user}): chown it and its folder to {user},"
            " or start the program as their owner"
        )
    except OSError:
        return ""
    return ""


def _reason(error: OSError) -> str:
    if isinstance(error, ssl.SSLError):
        known = {"KEY_VALUES_MISMATCH": "its key belongs to another certificate"}
        return known.get(error.reason or "", str(error.reason or error))
    return error.strerror or str(error)
