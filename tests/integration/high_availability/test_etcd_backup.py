"""``rce backup`` of a state in etcd while a master runs, and ``rce restore`` to an empty prefix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace
from support.etcd import Cluster, cluster
from support.master_program import rce
from support.masters import Masters, masters
from support.pushed import Pushed
from support.user_packages import KEY

from rce_master.etcd_backup import MORE_TERMS
from rce_master.state.changes import make_row
from rce_master.state.core import State
from rce_master.state.tables import Tables
from rce_master.state.volume_records import UserVolume
from rce_master.store import SqliteStore
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.store import EtcdStore

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.needs("etcd")]

LEASE_S = 4.0


async def push(made: Masters, folder: Path) -> Pushed:
    leader = await made.leader()
    async with made.session(60.0) as session:
        body = {"key": KEY.public, "label": "tests"}
        async with session.post(f"{leader.url}api/v1/package-keys", json=body) as reply:
            assert reply.status == 201, await reply.text()
    pushed = Pushed(folder, "kept")
    await pushed.push(made, leader)
    return pushed


async def back_up_under_load(etcd: Cluster, folder: Path) -> tuple[Pushed, set[str]]:
    """Make ``copy.tar``; return a package in it, and robots whose tokens are in it."""
    async with masters(folder / "one", etcd.store, count=1, lease=LEASE_S) as made:
        pushed = await push(made, folder)
        async with made.under_load():
            await made.wait_for_writes()
            before = set(made.acknowledged)
            state = ("--state-dir", "one/master0")
            told = await rce(folder, "backup", "copy.tar", "--store", etcd.store, *state)
            assert "made copy.tar: " in told
            told = await rce(folder, "restore", "copy.tar", "--store", etcd.store, *state, code=1)
            assert "a master is running on the state folder" in told
            beside = ("--state-dir", "beside")
            told = await rce(folder, "restore", "copy.tar", "--store", etcd.store, *beside, code=1)
            assert "the target holds a state already" in told
            other = ("--state-dir", "other")
            told = await rce(folder, "backup", "lacks.tar", "--store", etcd.store, *other, code=1)
            assert "run this on the machine of the leading master" in told
            await made.wait_for_writes()
    return pushed, before


async def test_a_backup_of_etcd_is_restored_elsewhere(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        pushed, before = await back_up_under_load(etcd, tmp_path)
        term = await EtcdStore(client, "/rce").newest_term()

        there = f"{etcd.store}/again"
        told = await rce(tmp_path, "restore", "copy.tar", "--store", there, "--state-dir", "again/master0")
        assert f"restored {there} as of" in told
        assert await EtcdStore(client, "/again").newest_term() > term + MORE_TERMS - 1
        async with masters(tmp_path / "again", there, count=1, lease=LEASE_S) as made:
            assert before - await made.stored() == set()
            assert pushed.holders(made) == made.all

        await rce(tmp_path, "restore", "copy.tar", "--state-dir", "alone")
        alone = await SqliteStore.open(tmp_path / "alone" / "master")
        restored = await alone.load()
        await alone.close()
        assert list(restored["users"]) == ["testUser"]
        await rce(tmp_path, "backup", "back.tar", "--state-dir", "alone")
        back = f"{etcd.store}/back"
        await rce(tmp_path, "restore", "back.tar", "--store", back, "--state-dir", "back/master")
        loaded = await EtcdStore(client, "/back").load()
        assert loaded == {table: rows for table, rows in restored.items() if rows}


async def test_volumes_are_restored_without_snapshots(tmp_path: Path) -> None:
    """A backup holds none of their contents: masters would look for them without end."""
    old = UserVolume(user="anna", name="a", size=1, snapshot="0" * 64, kept=5, taken=7.0)
    plain = UserVolume(user="anna", name="b", size=1)
    tables = Tables()
    for volume in (old, plain):
        tables.volumes.assign(volume.id, volume)
    store = await SqliteStore.open(tmp_path / "one" / "master")
    try:
        term = await store.begin_term()
        await store.save([make_row(tables.volumes, volume.id) for volume in (old, plain)], term)
    finally:
        await store.close()
    await rce(tmp_path, "backup", "copy.tar", "--state-dir", "one")
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        await rce(tmp_path, "restore", "copy.tar", "--store", f"{etcd.store}/a", "--state-dir", "two/master")
        restored = State()
        for _ in restored.reading(await EtcdStore(client, "/a").load()):
            pass
    assert list(restored.tables.volumes) == [replace(old, snapshot="", kept=0, taken=0.0), plain]


async def test_backups_that_cannot_be_made_or_restored(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        told = await rce(tmp_path, "backup", "none.tar", "--store", etcd.store, code=1)
        assert "etcd has no state of an engine below /rce/" in told
        assert not (tmp_path / "none.tar").exists()
        assert not (await client.range("/")).records, "a backup wrote to etcd"
        (tmp_path / "broken.tar").write_bytes(b"no tar")
        told = await rce(tmp_path, "restore", "broken.tar", "--store", etcd.store, code=1)
        assert "cannot restore broken.tar" in told
        told = await rce(tmp_path, "restore", "broken.tar", "--store", etcd.store, "--replace", code=2)
        assert "--replace is for folders" in told
        assert not (await client.range("/")).records
        told = await rce(tmp_path, "backup", "none.tar", "--store", "sqlite:x", code=2)
        assert "--store must be etcd://" in told
