"""The file in which ``rce login`` keeps its token."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import platformdirs
from msgspec import Struct

from rce_master.cli.exceptions import CliError, NotLoggedInError

FILE_VARIABLE = "RCE_LOGIN_FILE"


class Credentials(Struct, frozen=True, kw_only=True):
    """A login at a master."""

    url: str
    """URL of the master's HTTP server, with a slash at the end."""
    user: str
    token: str
    expires: float
    """Seconds since 1970."""
    authority: str = ""
    """File with the authority that issued the master's certificate; the system's authorities if empty."""

    def __repr__(self) -> str:
        return f"Credentials(url={self.url!r}, user={self.user!r})"


def login_file() -> Path:
    """Return the login's file: ``$RCE_LOGIN_FILE``, or a file in the user's configuration folder."""
    given = os.environ.get(FILE_VARIABLE)
    return Path(given) if given else platformdirs.user_config_path("rce") / "login.json"


def load() -> Credentials:
    """Read the login.

    Raises:
        NotLoggedInError: The user is not logged in.
        CliError: It cannot be read.
    """
    file = login_file()
    try:
        return msgspec.json.decode(file.read_bytes(), type=Credentials)
    except FileNotFoundError:
        raise NotLoggedInError from None
    except (OSError, msgspec.MsgspecError) as error:
        raise CliError(f"cannot read the login in {file}: {error}; run: rce login") from error


def save(credentials: Credentials) -> Path:
    """Keep a login where only its owner can read it.

    Returns:
        The file.

    Raises:
        CliError: It cannot be written.
    """
    file = login_file()
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as output:
            output.write(msgspec.json.encode(credentials))
        aside.replace(file)
    except OSError as error:
        raise CliError(f"cannot keep the login in {file}: {error}") from error
    return file


def forget() -> None:
    """Remove the login if it exists."""
    login_file().unlink(missing_ok=True)
