"""Snapshots of volumes, carried from one state folder to another while no master runs on either. Blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import SnapshotError
from rce.control.snapshots import decode_manifest
from rce_master.exceptions import StoreError
from rce_master.packages.carrying import copy_file, hash_of
from rce_master.snapshots.service import SNAPSHOTS
from rce_master.state.tables import Tables

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from rce_master.store import Snapshot


def carry_snapshots(state: Snapshot, source: Path, target: Path) -> tuple[Snapshot, list[str]]:
    """Copy the snapshots of volumes, each content after a check of its hash.

    Args:
        state: The state that names them.
        source: The state folder of a master that has them.
        target: The state folder that gets the contents that it lacks; may be the same.

    Returns:
        The state, and the volumes whose snapshots are missing or damaged: in it, these have none.

    Raises:
        StoreError: A content cannot be read or written.
    """
    lost: list[str] = []
    try:
        for volume, sha256 in _snapshots_of(state).items():
            contents = _contents_of(source / SNAPSHOTS, sha256)
            if any(hash_of(source / SNAPSHOTS / each) != each for each in contents):
                lost.append(volume)
                continue
            for each in contents:
                if not (target / SNAPSHOTS / each).exists():
                    copy_file(source / SNAPSHOTS / each, target / SNAPSHOTS)
    except OSError as error:
        raise StoreError(f"cannot copy snapshots of volumes from {source} to {target}: {error}") from error
    return without_snapshots(state, lost), sorted(lost)


def without_snapshots(state: Snapshot, volumes: Iterable[str] | None = None) -> Snapshot:
    """Return a state whose volumes have no snapshots, so that masters do not look for them without end.

    Args:
        state: The state.
        volumes: ``user/name`` of these volumes; None: of all.
    """
    table = Tables().volumes
    rows = dict(state.get(table.name, {}))
    for key in rows if volumes is None else volumes:
        table.write(key, rows[key])
        if table[key].snapshot:
            rows[key] = table.encode(replace(table[key], snapshot="", kept=0, taken=0.0))
    return {**state, table.name: rows}


def _snapshots_of(state: Snapshot) -> dict[str, str]:
    """Return the hash of each volume's manifest."""
    table = Tables().volumes
    for key, body in state.get(table.name, {}).items():
        table.write(key, body)
    return {known.id: known.snapshot for known in table if known.snapshot}


def _contents_of(folder: Path, sha256: str) -> list[str]:
    """Return the hashes of all contents of a snapshot: its manifest, and what this names."""
    try:
        named = decode_manifest((folder / sha256).read_bytes()).contents
    except (FileNotFoundError, SnapshotError):
        return [sha256]  # the check of its hash fails
    return [sha256, *sorted(named)]
