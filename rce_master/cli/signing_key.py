"""The key with which ``rce package push`` signs; beside the login."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from rce.packages import BadKeyError, SigningKey
from rce_master.cli.credentials import login_file
from rce_master.cli.exceptions import CliError

FILE_VARIABLE = "RCE_PACKAGE_KEY_FILE"
FILE_NAME = "package-key.pem"


def key_file() -> Path:
    """Return the key's file: ``$RCE_PACKAGE_KEY_FILE``, or a file beside the login."""
    given = os.environ.get(FILE_VARIABLE)
    return Path(given) if given else login_file().with_name(FILE_NAME)


def load() -> SigningKey | None:
    """Read the key; return None if it does not exist yet.

    Raises:
        CliError: It cannot be read, or others can read it.
    """
    file = key_file()
    try:
        mode = file.stat().st_mode
        text = file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CliError(f"cannot read the key {file}: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise CliError(f"the key {file} can be read by others; if it was not copied, run: chmod 600 {file}")
    try:
        return SigningKey.from_pem(text)
    except BadKeyError as error:
        raise CliError(f"{file}: {error}") from error


def load_or_make() -> tuple[SigningKey, bool]:
    """Read the key, or make it.

    Returns:
        The key, and whether it is new.

    Raises:
        CliError: It cannot be read or written.
    """
    there = load()
    if there is not None:
        return there, False
    file, key = key_file(), SigningKey.generate()
    aside = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with os.fdopen(descriptor, "wb") as output:
                output.write(key.to_pem())
            file.hardlink_to(aside)  # another program may have made the key first; that one counts
        finally:
            aside.unlink()
    except FileExistsError:
        return load_or_make()
    except OSError as error:
        raise CliError(f"cannot keep a new key in {file}: {error.strerror}") from error
    return key, True
