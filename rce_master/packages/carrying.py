"""Archives of packages, carried from one state folder to another while no master runs on either. Blocks."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from rce_master.exceptions import StoreError
from rce_master.packages.contents import ARCHIVES
from rce_master.state.tables import Tables
from rce_master.state.user_records import UserPackage
from rce_master.state.volume_records import SavedState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.store import Snapshot

_SHOWN = 5
"""Packages that a message names."""
_PIECE = 1 << 20


def packages_of(snapshot: Snapshot) -> list[UserPackage]:
    """Return the packages of a state."""
    rows = snapshot.get(Tables().packages.name, {})
    return [msgspec.json.decode(body, type=UserPackage) for body in rows.values()]


def states_of(snapshot: Snapshot) -> list[SavedState]:
    """Return the saved states of nodes."""
    rows = snapshot.get(Tables().saved_states.name, {})
    return [msgspec.json.decode(body, type=SavedState) for body in rows.values()]


def carry(contents: Iterable[UserPackage | SavedState], source: Path, target: Path) -> int:
    """Copy the archives of packages and the saved states of nodes, each after a check of its hash.

    Args:
        contents: Of what.
        source: The state folder of a master that has them.
        target: The state folder that gets those that it lacks; may be the same.

    Returns:
        How many there are.

    Raises:
        StoreError: Archives are missing or damaged, or cannot be written.
    """
    names = {one.sha256: one.id for one in contents}
    try:
        missing = [name for sha256, name in names.items() if hash_of(source / ARCHIVES / sha256) != sha256]
        if missing:
            shown = ", ".join([*missing[:_SHOWN], *(["..."] if len(missing) > _SHOWN else [])])
            raise StoreError(
                f"{source / ARCHIVES} lacks the archives of {shown}, or they are damaged; name the state"
                " folder of a master that has them, or remove these first: rce package remove, or rce state"
                " remove"
            )
        for sha256 in names:
            if not (target / ARCHIVES / sha256).exists():
                copy_file(source / ARCHIVES / sha256, target / ARCHIVES)
    except OSError as error:
        raise StoreError(f"cannot copy packages from {source} to {target}: {error}") from error
    return len(names)


def hash_of(path: Path) -> str:
    """Return the SHA-256 of a file in hex; empty if it does not exist."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return ""


def copy_file(path: Path, folder: Path) -> None:
    """Copy a file into a folder, where it appears whole or not at all."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=folder, prefix=".")
    try:
        with path.open("rb") as source, os.fdopen(descriptor, "wb") as out:
            while piece := source.read(_PIECE):
                out.write(piece)
            out.flush()
            os.fsync(out.fileno())
        Path(name).rename(folder / path.name)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
