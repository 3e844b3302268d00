"""Engines that share an etcd, each below a prefix of its own: a machine is removed from all of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.etcd import cluster
from support.master_program import rce

from rce_master.cluster.client import ClusterClient
from rce_master.cluster.engines import find_prefixes, known_masters
from rce_master.cluster.joining import forget_machine
from rce_master.store import Row
from rce_master.store.etcd import EtcdStore
from rce_master.store.etcd.layout import Keys, prepare, write_master
from rce_master.store.etcd.wire import Put

pytestmark = pytest.mark.needs("etcd")

PREFIXES = ["/a/fleet", "/rce", "/rce/inner", "/zoo"]
ROWS = 1200
"""More than are read at a time."""


async def test_a_machine_is_forgotten_in_all_engines_of_an_etcd(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, ClusterClient(etcd.endpoints, attempt=20.0) as client:
        assert await find_prefixes(client) == []
        for prefix in PREFIXES:
            keys = Keys(prefix)
            await client.transact([], [Put(keys.schema, b"2")])
            await EtcdStore(client, prefix).save([Row("schema", f"{n}/schema", b"") for n in range(ROWS)])
            places = {"m1:9000": "http://10.0.0.1:9000/", "m3:9001": "http://10.0.0.3:9001/"}
            masters = [Put(keys.masters + name, write_master(url)) for name, url in places.items()]
            await client.transact([], [*masters, Put(f"{keys.drained}m3:9001", b"")])
        await client.transact([], [Put("/other/key", b""), Put("/zoo-keeper/masters/m3:9001", b"")])
        await prepare(client, "/rce")
        assert sorted(await find_prefixes(client)) == PREFIXES
        assert len(await known_masters(client)) == 2 * len(PREFIXES)
        gone = await forget_machine(client, "m3", "10.0.0.3")
        assert sorted(gone) == sorted(
            "m3:9001" if prefix == "/rce" else f"m3:9001 of {prefix}" for prefix in PREFIXES
        )
        left = await known_masters(client)
        assert {(one.name, one.host) for one in left} == {("m1:9000", "10.0.0.1")}
        assert sorted(one.prefix for one in left) == PREFIXES
        for prefix in PREFIXES:
            assert not (await client.range(Keys(prefix).drained)).records


async def test_removal_that_was_interrupted_is_repeated(tmp_path: Path) -> None:
    """Without the end of it, the lost master counts for a day: packages may find no majority."""
    async with cluster(tmp_path / "etcd") as etcd, ClusterClient(etcd.endpoints, attempt=20.0) as client:
        await prepare(client, "/rce")
        keys = Keys("/rce")
        places = {"m1:9000": "http://10.0.0.1:9000/", "m3:9000": "http://10.0.0.3:9000/"}
        await client.transact(
            [], [Put(keys.masters + name, write_master(url)) for name, url in places.items()]
        )
        there = ("--etcd", etcd.endpoints[0], "--no-tls")
        told = await rce(tmp_path, "cluster", "remove", "m4", *there, code=1)
        assert "no member is named 'm4'; members: m0" in told
        told = await rce(tmp_path, "cluster", "remove", "m3", *there)
        assert "etcd has no member m3: it was removed before" in told
        assert "the other masters do not count m3:9000 any more" in told
        assert [one.name for one in await known_masters(client)] == ["m1:9000"]
