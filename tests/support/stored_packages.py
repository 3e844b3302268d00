"""A package of a user in the store of a master that does not run."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from rce_master.state.tables import Tables
from rce_master.state.user_records import UserPackage
from rce_master.store import Row, SqliteStore


async def store_package(state: Path, archive: bytes) -> Path:
    """Add a package to the state in a folder; return where its archive has to be."""
    sha256 = hashlib.sha256(archive).hexdigest()
    package = UserPackage(
        user="anna",
        name="tools",
        version="1.0",
        sha256=sha256,
        digest="",
        key="",
        signature="",
        packed=len(archive),
        size=1,
        files=1,
        created=1.0,
    )
    store = await SqliteStore.open(state)
    rows = [Row(Tables().packages.name, package.id, msgspec.json.encode(package))]
    await store.save(rows, await store.begin_term())
    await store.close()
    return state / "bundles" / sha256
