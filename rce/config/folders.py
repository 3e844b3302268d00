"""The engine's folders: for its state and its sockets, and those that ship with the project."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

import rce
from rce.config.exceptions import RunDirError, ShippedFileError

if TYPE_CHECKING:
    from collections.abc import Mapping

MASTER_FOLDER = "master"
"""The folder of the master's state in an engine's state folder."""
STORE_FILE = "rce.sqlite"
"""The file of a master's state, in its folder."""
ETCD_FILE = "etcd.yaml"
"""The file with the configuration of a machine's member of etcd, in its engine's state folder."""

_PACKAGE = Path(rce.__file__).resolve().parent


def default_state_dir() -> Path:
    """Return the default folder for state, such as ``~/.local/state/rce``. Does not create it."""
    return platformdirs.user_state_path("rce")


def master_folder(state_dir: Path) -> Path:
    """Return the folder of the master's state in the folder that ``rce-master`` is given.

    That is the folder itself, or the folder ``master`` in it where only that holds a state: the named folder
    is then that of an engine (``rce up --state-dir``), or ``rce user add --state-dir`` or ``rce master copy``
    made it.
    """
    inner = state_dir / MASTER_FOLDER
    only_inner = (inner / STORE_FILE).exists() and not (state_dir / STORE_FILE).exists()
    return inner if only_inner else state_dir


def run_dir(environ: Mapping[str, str] | None = None) -> Path:
    """Return this user's folder for sockets, ``$XDG_RUNTIME_DIR/rce`` or ``/tmp/rce-UID``; make it if needed.

    It is short, because the path of a unix socket may have at most 107 bytes, and only its owner may enter.
    ``$XDG_RUNTIME_DIR`` counts only if it is this user's: ``su`` and ``sudo`` may hand on another one's.

    Raises:
        RunDirError: It cannot be made, is not a folder, or another user owns it.
    """
    environ = os.environ if environ is None else environ
    runtime = environ.get("XDG_RUNTIME_DIR", "")
    if runtime and _is_mine(Path(runtime)):
        return private_folder(Path(runtime) / "rce")
    return private_folder(Path(f"/tmp/rce-{os.getuid()}"))  # noqa: S108 - private_folder checks whose it is


def _is_mine(path: Path) -> bool:
    try:
        found = path.stat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()


def private_folder(path: Path) -> Path:
    """Make a folder that only its owner may enter, or check that an existing one is such a folder.

    Raises:
        RunDirError: It cannot be made, is not a folder, or another user owns it.
    """
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
            raise RunDirError(
                f"{path} is not a folder of user {os.getuid()}; remove it or set XDG_RUNTIME_DIR"
            )
        if stat.S_IMODE(found.st_mode) != stat.S_IRWXU:
            path.chmod(stat.S_IRWXU)
    except OSError as error:
        raise RunDirError(f"cannot use {path} for sockets: {error}") from error
    return path


def examples_dir() -> Path:
    """Return the folder of example packages.

    Raises:
        ShippedFileError: It was not shipped.
    """
    return _find("examples")


def configs_dir() -> Path:
    """Return the folder of example configs and default settings.

    Raises:
        ShippedFileError: It was not shipped.
    """
    return _find("configs")


def _find(name: str) -> Path:
    # A wheel holds the folders inside the package; a checkout has them beside it.
    candidates = (_PACKAGE / "share" / name, _PACKAGE.parent / name)
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise ShippedFileError(f"folder {name!r} is neither {candidates[0]} nor {candidates[1]}")
