"""Backups of a state in etcd: made while masters run, restored to an empty prefix while none leads. Blocks.

The file is that of :mod:`rce_master.backup`: its store is an SQLite file, which the rows of etcd are exported
to, as they are at one revision. So a backup of one store can be restored to the other.
"""

from __future__ import annotations

import asyncio
import tarfile
import tempfile
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rce.tls import CertificateError
from rce_master.backup import MASTER, BackupError, check_store, extract, locked, packages_in
from rce_master.exceptions import StoreError
from rce_master.packages.carrying import carry
from rce_master.snapshots.carrying import without_snapshots
from rce_master.state_service import load_converted
from rce_master.store.base import Row
from rce_master.store.copying import batches, check_finished, copy_rows
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.layout import check_state, prepare
from rce_master.store.sqlite import FILE_NAME, SqliteStore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from rce.config import EtcdAddress
    from rce.tls.choice import TlsChoice
    from rce_master.backup import Copy

ATTEMPT_S = 5.0
"""How long one member of etcd may take for an answer."""
MORE_TERMS = 1000
"""By how much the first term after a restore is greater than that of the backup: more terms than have begun
since, so that task sets listen to the new masters at once."""


@contextmanager
def exported(address: EtcdAddress, tls: TlsChoice) -> Iterator[Path]:
    """Export the state to an SQLite file, which is removed at the end.

    Raises:
        StoreError: There is no state, or it cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="rce-backup-") as name:
        asyncio.run(_export(address, tls, Path(name)))
        yield Path(name) / FILE_NAME


def restore_to_etcd(file: Path, folder: Path, address: EtcdAddress, tls: TlsChoice) -> Copy:
    """Restore a copy's state to an empty prefix of etcd, and its archives of packages to a state folder.

    The whole copy is read and checked before anything changes. If it is interrupted, no master starts on a
    part of the state, and it can be repeated.

    Args:
        file: The copy.
        folder: The state folder of the master of this machine.
        address: Of etcd.
        tls: How to reach it.

    Returns:
        The copy's manifest.

    Raises:
        StoreBusyError: A master runs on the folder, or leads.
        StoreError: The copy is incomplete or was made by a newer program, or etcd has a state there already.
    """
    with locked(folder):
        try:
            with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".rce-restore-") as name:
                found = extract(file, Path(name))
                source = Path(name) / MASTER
                check_store(source / FILE_NAME)
                carry(packages_in(source / FILE_NAME), source, folder)
                asyncio.run(_import(source, address, tls))
        except (OSError, tarfile.TarError) as error:
            raise BackupError(f"cannot restore {file}: {error}") from error
    return found


async def _export(address: EtcdAddress, tls: TlsChoice, folder: Path) -> None:
    async with _connected(address, tls) as client:
        await check_state(client, address.prefix)
        store = EtcdStore(client, address.prefix)
        snapshot = await store.load()
        check_finished(snapshot)
        term = await store.newest_term()
    copy = await SqliteStore.open(folder)
    try:
        own = await copy.begin_term(above=max(0, term - 1))
        rows = (Row(table, key, body) for table, found in snapshot.items() for key, body in found.items())
        for batch in batches(rows):
            await copy.save(batch, own)
    finally:
        await copy.close()


async def _import(folder: Path, address: EtcdAddress, tls: TlsChoice) -> None:
    copy = await SqliteStore.open(folder)
    try:
        term = await copy.begin_term()
        # A copy holds none of the snapshots' contents.
        snapshot = without_snapshots(await load_converted(copy, term))
    finally:
        await copy.close()
    async with _connected(address, tls) as client:
        await prepare(client, address.prefix)
        await copy_rows(snapshot, EtcdStore(client, address.prefix), above=term + MORE_TERMS)


@asynccontextmanager
async def _connected(address: EtcdAddress, tls: TlsChoice) -> AsyncIterator[EtcdClient]:
    try:
        identity = tls.own_identity() if address.tls else None
    except CertificateError as error:
        raise StoreError(str(error)) from error
    contexts = None if identity is None else identity.client
    async with EtcdClient(address.endpoints, tls=contexts, attempt=ATTEMPT_S) as client:
        yield client
