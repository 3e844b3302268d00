"""The secret that the engine's programs share and prove to each other on the control channel."""

from __future__ import annotations

import contextlib
import hmac
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
    from collections.abc import Mapping

SECRET_VARIABLE = "RCE_SECRET"  # noqa: S105 - the variable's name
SECRET_FILE_VARIABLE = "RCE_SECRET_FILE"  # noqa: S105
DEV_SECRET_NAME = "dev-secret"  # noqa: S105
MIN_LENGTH = 8


class Secret:
    """A secret that does not show in logs, tracebacks or ``repr``."""

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
        """Return the text."""
        return self._text

    def matches(self, text: str) -> bool:
        """Compare in a time that does not depend on where the two differ."""
        return hmac.compare_digest(self._text.encode(), text.encode("utf-8", "surrogateescape"))

    def derive(self, purpose: str) -> bytes:
        """Make a key of it that is good for one purpose, and tells nothing of the secret."""
        return hmac.digest(self._text.encode(), f"rce {purpose}".encode(), "sha256")

    def __eq__(self, other: object) -> bool:
        return self.matches(other._text) if isinstance(other, Secret) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._text)

    def __repr__(self) -> str:
        return "Secret('***')"

    __str__ = __repr__


def load_secret(
    file: Path | None = None, *, dev: bool = False, environ: Mapping[str, str] | None = None
) -> Secret:
    """Find the secret.

    The first of: ``file``; the variable ``RCE_SECRET``; the file that ``RCE_SECRET_FILE`` names; in
    development mode the one of this user and machine, which is made when there is none; else the one that
    ``rce secret new`` made for this user.

    Raises:
        SecretError: There is none, or it is too short, or others can read its file.
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
    """Return where a user's secret is, if nothing else was said, such as ``~/.config/rce/secret``."""
    return platformdirs.user_config_path("rce") / "secret"


def new_secret(file: Path) -> Secret:
    """Make a secret in a file that only its owner may read.

    Raises:
        SecretError: There is such a file already, or it cannot be made.
    """
    secret = Secret.generate()
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise SecretError(f"cannot make the folder {file.parent}: {error.strerror}") from error
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as output:
            output.write(secret.reveal() + "\n")
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
    try:
        mode = file.stat().st_mode
        text = file.read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise SecretError(f"cannot read the secret from {file}: {error}") from error
    if stat.S_ISREG(mode) and mode & (stat.S_IRWXG | stat.S_IRWXO) & ~stat.S_IRGRP:
        raise SecretError(f"{file} can be read by everybody; run: chmod 600 {file}")
    return Secret(text)


def shared_dev_secret(folder: Path) -> Secret:
    """Return the secret in ``folder``; whoever comes first makes it.

    The file appears whole or not at all (it is written aside and then linked), so programs that start at the
    same moment agree.

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
