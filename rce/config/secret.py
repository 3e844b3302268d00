"""The secret that the engine's programs share and prove to each other on the control channel."""

from __future__ import annotations

import contextlib
import hmac
import logging
import os
import secrets
import stat
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from rce.config.exceptions import SecretError
from rce.config.folders import run_dir

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_log = logging.getLogger(__name__)

SECRET_VARIABLE = "RCE_SECRET"  # noqa: S105 - the variable's name
SECRET_FILE_VARIABLE = "RCE_SECRET_FILE"  # noqa: S105
DEV_SECRET_NAME = "dev-secret"  # noqa: S105
MIN_LENGTH = 8


class Secret:
    """A secret that is hidden in logs, tracebacks and ``repr``."""

    __slots__ = ("_text",)

    def __init__(self, text: str) -> None:
        text = text.strip()
        if len(text) < MIN_LENGTH or not text.isascii() or not text.isprintable():
            raise SecretError(f"the secret must have at least {MIN_LENGTH} printable ASCII characters")
        self._text = text

    @classmethod
    def generate(cls) -> Secret:
        """Make a new random secret."""
        return cls(secrets.token_urlsafe(32))

    def reveal(self) -> str:
        """Return the text to show."""
        return self._text

    def was_refused(self, text: str) -> bool:
        """Note that a text that was shown was refused; return whether there is another one to show."""
        del text
        return False

    def matches(self, text: str) -> bool:
        """Compare in a time that does not depend on where the two differ."""
        return hmac.compare_digest(self._text.encode(), text.encode("utf-8", "surrogateescape"))

    def derive(self, purpose: str) -> bytes:
        """Derive a key for one purpose, which reveals nothing of the secret."""
        return _derive(self._text, purpose)

    def derive_all(self, purpose: str) -> tuple[bytes, ...]:
        """Derive a key from each secret that is accepted, the current one first."""
        return (_derive(self._text, purpose),)

    def sign(self, purpose: str, text: str) -> str:
        """Return the proof that a program which knows the secret wrote a text.

        It has a MAC for each secret that is accepted: another machine may not have the current one yet.

        Args:
            purpose: Of the text: a proof for one purpose proves nothing for another.
            text: What is signed.
        """
        return ",".join(_macs(self.derive_all(purpose), text))

    def has_signed(self, purpose: str, text: str, proof: str) -> bool:
        """Tell whether a proof is of :meth:`sign`, with at least one secret that is accepted here."""
        given = proof.encode("utf-8", "surrogateescape").split(b",")
        found = [
            hmac.compare_digest(mac.encode(), one)
            for mac in _macs(self.derive_all(purpose), text)
            for one in given
        ]
        return any(found)

    def __eq__(self, other: object) -> bool:
        return self.matches(other._text) if isinstance(other, Secret) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._text)

    def __repr__(self) -> str:
        return "Secret('***')"

    __str__ = __repr__


def _derive(text: str, purpose: str) -> bytes:
    return hmac.digest(text.encode(), f"rce {purpose}".encode(), "sha256")


def _macs(keys: Iterable[bytes], text: str) -> list[str]:
    return [hmac.digest(key, text.encode("utf-8", "surrogateescape"), "sha256").hex() for key in keys]


class SecretFile(Secret):
    """The secret in a file, which may change while programs run.

    Each line is a secret: the first is the current one, the others are still accepted. So a secret can be
    changed without ending a connection: put the new one before the old one (:func:`rotate_secret`), copy it
    into every machine's file, then remove the old one (:func:`retire_secrets`). If the file cannot be read,
    the secrets that were read last stay in use.

    Raises:
        SecretError: The file cannot be read, has no valid secret, or others can read it.
    """

    __slots__ = ("_fault", "_file", "_refused", "_seen", "_texts")

    def __init__(self, file: Path) -> None:
        self._file = file
        self._seen = _stamp(file)
        self._texts = _read_lines(file)
        self._refused: set[str] = set()
        self._fault: object = None
        """The last one that was logged."""
        super().__init__(self._texts[0])

    def reveal(self) -> str:
        """Return the text to show: the current one, or another that was not refused where that was."""
        self._look()
        return next((text for text in self._texts if text not in self._refused), self._texts[0])

    def matches(self, text: str) -> bool:
        """Compare with all accepted secrets, in a time that does not depend on where they differ."""
        self._look()
        given = text.encode("utf-8", "surrogateescape")
        found = [hmac.compare_digest(known.encode(), given) for known in self._texts]
        return any(found)

    def derive_all(self, purpose: str) -> tuple[bytes, ...]:
        """Derive a key from each secret that is accepted, the current one first."""
        self._look()
        return tuple(_derive(text, purpose) for text in self._texts)

    def was_refused(self, text: str) -> bool:
        """Note that a text that was shown was refused; return whether there is another one to show."""
        self._refused.add(text)
        if all(known in self._refused for known in self._texts):
            self._refused.clear()
            return False
        return True

    def _look(self) -> None:
        """Read the file again if it changed, or could not be read: its permissions are not in its stamp."""
        stamp = None
        try:
            stamp = _stamp(self._file)
            if stamp == self._seen:
                return
            self._texts = _read_lines(self._file)
        except SecretError as error:
            fault = (stamp, str(error))
            if fault != self._fault:
                _log.error("the former secret stays in use: %s", error)
            self._fault = fault
            return
        self._seen, self._fault = stamp, None
        self._text = self._texts[0]
        self._refused.clear()
        _log.info("%s was read again: %d accepted", self._file, len(self._texts))


def load_secret(
    file: Path | None = None, *, dev: bool = False, environ: Mapping[str, str] | None = None
) -> Secret:
    """Find the secret.

    The first of: ``file``; the variable ``RCE_SECRET``; the file that ``RCE_SECRET_FILE`` names; in
    development mode the one of this user and machine, which is made if it does not exist; else the one that
    ``rce secret new`` made for this user.

    Raises:
        SecretError: No secret was found, or it is too short, or others can read its file.
    """
    environ = os.environ if environ is None else environ
    if file is not None:
        return read_secret(file)
    if environ.get(SECRET_VARIABLE):
        return Secret(environ[SECRET_VARIABLE])
    if environ.get(SECRET_FILE_VARIABLE):
        return read_secret(Path(environ[SECRET_FILE_VARIABLE]))
    if dev:
        return shared_dev_secret(run_dir(environ))
    default = default_secret_file()
    if default.exists():
        return read_secret(default)
    raise SecretError(
        "the engine's programs need a shared secret: run `rce secret new` on one machine and copy its file to"
        f" the same place on the others ({default}); {SECRET_VARIABLE}, {SECRET_FILE_VARIABLE} and"
        " --secret-file do as well; --dev needs none"
    )


def default_secret_file() -> Path:
    """Return the default path of a user's secret, such as ``~/.config/rce/secret``."""
    return platformdirs.user_config_path("rce") / "secret"


def new_secret(file: Path) -> Secret:
    """Make a secret in a file that only its owner may read.

    Raises:
        SecretError: The file exists already, or cannot be made.
    """
    secret = Secret.generate()
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise SecretError(f"cannot make the folder {file.parent}: {error.strerror}") from error
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(descriptor, "w", encoding="ascii") as output:
                output.write(secret.reveal() + "\n")
        except OSError:
            file.unlink()  # an empty file would count as a secret that is there already
            raise
    except FileExistsError:
        raise SecretError(
            f"{file} is there already; programs that use it would not know another one. Remove it first"
        ) from None
    except OSError as error:
        raise SecretError(f"cannot make the secret {file}: {error.strerror}") from error
    return secret


def read_secret(file: Path) -> Secret:
    """Read a secret from a file that only its owner may read.

    Raises:
        SecretError: It cannot be read, is too short, or others can read it.
    """
    return SecretFile(file) if file.is_file() else Secret(_read_lines(file)[0])


def rotate_secret(file: Path) -> None:
    """Put a new secret before the one in a file, which stays accepted.

    Raises:
        SecretError: The file cannot be read or written, or still has a former secret.
    """
    texts = _read_lines(file)
    if len(texts) > 1:
        raise SecretError(
            f"{file} holds a former secret still; when every machine has the file, run: rce secret retire"
        )
    _replace(file, [Secret.generate().reveal(), *texts])


def retire_secrets(file: Path) -> int:
    """Remove all secrets from a file but the current one; return how many.

    Raises:
        SecretError: The file cannot be read or written.
    """
    current, *former = _read_lines(file)
    if former:
        _replace(file, [current])
    return len(former)


def _stamp(file: Path) -> tuple[int, int, int]:
    try:
        found = file.stat()
    except OSError as error:
        raise SecretError(f"cannot read the secret from {file}: {error}") from error
    return found.st_ino, found.st_mtime_ns, found.st_size


def _read_lines(file: Path) -> list[str]:
    """Read the secrets of a file, the current one first."""
    try:
        found = file.stat()
        text = file.read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise SecretError(f"cannot read the secret from {file}: {error}") from error
    if stat.S_ISREG(found.st_mode) and found.st_mode & (stat.S_IRWXG | stat.S_IRWXO) & ~stat.S_IRGRP:
        # A service's file is root's, and read through its group.
        allowed = "640" if found.st_uid == 0 and found.st_gid != 0 else "600"
        raise SecretError(f"{file} can be read by other users; run: chmod {allowed} {file}")
    lines = [line for line in text.splitlines() if line.strip()]
    return [Secret(line).reveal() for line in lines or [""]]


def _replace(file: Path, texts: list[str]) -> None:
    """Replace a file atomically, with the same owner and permissions."""
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        was = file.stat()
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as output:
            output.write("".join(f"{text}\n" for text in texts))
            output.flush()
            os.fsync(descriptor)
            os.fchmod(descriptor, stat.S_IMODE(was.st_mode))
            if (was.st_uid, was.st_gid) != (os.geteuid(), os.getegid()):
                os.fchown(descriptor, was.st_uid, was.st_gid)
        aside.replace(file)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise SecretError(f"cannot write the secret {file}: {error}") from error


def shared_dev_secret(folder: Path) -> Secret:
    """Return the secret in ``folder``; the first program makes it.

    The file is created atomically (it is written aside and then linked), so programs that start at the same
    moment agree.

    Raises:
        SecretError: It cannot be made or read.
    """
    file = folder / DEV_SECRET_NAME
    if not file.exists():
        try:
            _create(file, Secret.generate())
        except OSError as error:
            raise SecretError(f"cannot make the development secret {file}: {error}") from error
    return read_secret(file)


def _create(file: Path, secret: Secret) -> None:
    descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}-")
    aside = Path(name)
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as output:
            output.write(secret.reveal() + "\n")
        with contextlib.suppress(FileExistsError):  # another program was first: its secret counts
            file.hardlink_to(aside)
    finally:
        aside.unlink()
