"""``rce master copy``: a state moves from SQLite to a real etcd and back."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import msgspec
import pytest
from msgspec import structs
from support.etcd import cluster
from support.go_between import LOOPBACK
from support.master_program import rce
from support.stored_packages import store_package

from rce.config import STORE_FILE, EngineSettings, MasterSettings
from rce.control.snapshots import FileEntry, Manifest
from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce_master.state.tables import Tables
from rce_master.state.volume_records import UserVolume
from rce_master.store import Row, SqliteStore
from rce_master.store.copying import UNFINISHED
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.layout import prepare
from rce_master.store.etcd.store import Candidacy

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.needs("etcd")]

MANY = 3000


async def make_state(folder: Path) -> None:
    """Make a state with a user, as rce user does it, and many rows more."""
    await rce(
        folder, "user", "add", "anna", "--password-stdin", "--state-dir", "state", text="secret\nsecret\n"
    )
    store = await SqliteStore.open(folder / "state" / "master")
    rows = [Row("many", f"a b/{number}", b"x" * (number % 500)) for number in range(MANY)]
    await store.save(rows, await store.begin_term())
    await store.close()


async def test_a_state_is_copied_to_etcd_and_back(tmp_path: Path) -> None:
    await make_state(tmp_path)
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        there = f"{etcd.store}/one"
        told = await rce(tmp_path, "master", "copy", "--from", "sqlite:state", "--to", there)
        assert f"copied {MANY + 1} records to {there}; start no master on {tmp_path}/state" in told
        in_etcd = EtcdStore(client, "/one")
        copied = await in_etcd.load()
        assert list(copied["users"]) == ["anna"]
        assert len(copied["many"]) == MANY

        told = await rce(tmp_path, "master", "copy", "--from", "sqlite:state", "--to", there, code=1)
        assert "the target holds a state already (3000 many, 1 users)" in told
        told = await rce(tmp_path, "master", "copy", "--from", "sqlite:nothing", "--to", there, code=1)
        assert "nothing/master, which holds no state" in told
        assert not (tmp_path / "nothing").exists()
        told = await rce(tmp_path, "master", "copy", "--from", there, "--to", there, code=1)
        assert "name the same store" in told
        told = await rce(tmp_path, "master", "copy", "--from", "mysql://x", "--to", there, code=1)
        assert "--from must be sqlite:FOLDER or etcd://" in told

        await rce(tmp_path, "master", "copy", "--from", there, "--to", "sqlite:back")
        settings = EngineSettings(master=MasterSettings(store=f"sqlite:{tmp_path}/back"))
        assert (settings.master_state / STORE_FILE).exists(), "a master with this store begins with it"
        back = await SqliteStore.open(tmp_path / "back" / "master")
        assert {table: rows for table, rows in (await back.load()).items() if rows} == copied
        assert await back.begin_term() > await in_etcd.begin_term()
        await back.close()

        lease, _ = await client.grant(60)
        await EtcdStore(client, "/one", Candidacy(lease, "one:9000", lambda: 60.0)).begin_term()
        told = await rce(tmp_path, "master", "copy", "--from", there, "--to", "sqlite:again", code=1)
        assert "another master leads: one:9000; the state is copied while no master runs" in told


async def add_package(folder: Path, archive: bytes) -> Path:
    """Add a package to the state; return where its archive has to be."""
    return await store_package(folder / "state" / "master", archive)


async def test_archives_of_packages_move_too(tmp_path: Path) -> None:
    await make_state(tmp_path)
    archive = await add_package(tmp_path, b"an archive")
    own = ("--state-dir", "beside/master")
    async with cluster(tmp_path / "etcd") as etcd:
        copy = ("copy", "--from", "sqlite:state", "--to", etcd.store, *own)
        archive.parent.mkdir()
        for damage in (None, b"another one"):
            if damage is not None:
                archive.write_bytes(damage)
            told = await rce(tmp_path, "master", *copy, code=1)
            assert "lacks the archives of anna/tools@1.0, or they are damaged" in told
        archive.write_bytes(b"an archive")
        told = await rce(tmp_path, "master", *copy)
        beside = tmp_path / "beside" / "master" / "bundles" / archive.name
        assert (
            f"1 packages and states of nodes, and snapshots of volumes, are in {beside.parent.parent}" in told
        )
        assert beside.read_bytes() == b"an archive"
        await rce(tmp_path, "master", "copy", "--from", etcd.store, "--to", "sqlite:back", *own)
    assert (tmp_path / "back" / "master" / "bundles" / archive.name).read_bytes() == b"an archive"


async def add_volumes(folder: Path, *volumes: UserVolume) -> None:
    store = await SqliteStore.open(folder / "state" / "master")
    rows = [Row(Tables().volumes.name, volume.id, msgspec.json.encode(volume)) for volume in volumes]
    await store.save(rows, await store.begin_term())
    await store.close()


async def test_snapshots_of_volumes_move_too(tmp_path: Path) -> None:
    """A volume whose snapshot lacks a part has none at the target, where masters would look without end."""
    await make_state(tmp_path)
    piece, missing = (bytes([number]) * 1000 for number in range(2))
    file = FileEntry(
        path=b"f", mode=0o644, modified_ns=1, size=1000, pieces=(hashlib.sha256(piece).digest(),)
    )
    manifest = Manifest(entries=(file,)).encode()
    other = structs.replace(file, pieces=(hashlib.sha256(missing).digest(),))
    damaged = Manifest(entries=(file, structs.replace(other, path=b"g"))).encode()
    contents = {hashlib.sha256(each).hexdigest(): each for each in (piece, manifest, damaged)}
    names = list(contents)
    whole = UserVolume(user="anna", name="a", size=1, snapshot=names[1], kept=1000, taken=7.0)
    lost = UserVolume(user="anna", name="b", size=1, snapshot=names[2], kept=2000, taken=7.0)
    await add_volumes(tmp_path, whole, lost)
    (tmp_path / "state" / "master" / "snapshots").mkdir()
    for name, content in contents.items():
        (tmp_path / "state" / "master" / "snapshots" / name).write_bytes(content)
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        told = await rce(
            *(tmp_path, "master", "copy", "--from", "sqlite:state", "--to", f"{etcd.store}/one"),
            *("--state-dir", "beside/master"),
        )
        rows = (await EtcdStore(client, "/one").load())["volumes"]
    assert "volume anna/b is copied without its snapshot" in told
    assert "volume anna/a" not in told
    found = {key: msgspec.json.decode(body, type=UserVolume) for key, body in rows.items()}
    assert found == {whole.id: whole, lost.id: structs.replace(lost, snapshot="", kept=0, taken=0.0)}
    beside = tmp_path / "beside" / "master" / "snapshots"
    assert {path.name: path.read_bytes() for path in beside.iterdir()} == {
        name: contents[name] for name in names[:2]
    }


async def test_state_is_copied_to_etcd_over_tls(tmp_path: Path) -> None:
    """The certificates are where ``rce cluster`` makes them, or where the settings say."""
    await make_state(tmp_path)
    folder = CertificateFolder(tmp_path / "machine" / "certificates")
    folder.make_authority()
    folder.issue("engine", hosts=[LOOPBACK])
    certificate, key = folder.certificate("engine"), folder.key("engine")
    options = [
        *("--cert-file", str(certificate), "--key-file", str(key)),
        *("--client-cert-auth", "--trusted-ca-file", str(folder.authority)),
    ]
    tls = TlsIdentity(TlsFiles(certificate, key, folder.authority)).client
    (tmp_path / "engine.yaml").write_text(f"tls: {{certificates: {folder.path}}}\n")
    async with cluster(tmp_path / "etcd", 1, *options, tls=tls) as etcd:
        for number, words in enumerate((("--state-dir", "machine"), ("--config", "engine.yaml"))):
            there = f"etcds://{etcd.endpoints[0]}/{number}"
            told = await rce(tmp_path, "master", "copy", "--from", "sqlite:state", "--to", there, *words)
            assert f"copied {MANY + 1} records to {there}" in told


async def test_parts_of_a_state_are_refused(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=20.0) as client:
        await prepare(client, "/part")
        await EtcdStore(client, "/part").save([Row(UNFINISHED, "mark", b"{}")])
        there = f"{etcd.store}/part"
        told = await rce(tmp_path, "master", "copy", "--from", there, "--to", "sqlite:part", code=1)
        assert "a copy into this store was not finished" in told
