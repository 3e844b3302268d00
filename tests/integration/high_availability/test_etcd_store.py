"""The store in a real etcd: the laws of every store, fences, and answers that are lost."""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path

import aiohttp
import pytest
from support.etcd import Cluster, CuttingProxy
from support.master_program import rce
from support.store_laws import check_round_trip, check_snapshot, check_terms

from rce_master.exceptions import FencedError, SaveTooLargeError, StaleTermError, StoreBusyError, StoreError
from rce_master.store import Row
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.layout import Keys, prepare
from rce_master.store.etcd.store import Candidacy, load_rows
from rce_master.store.etcd.wire import Put

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

_numbers = itertools.count(1)


@pytest.fixture
def prefix() -> str:
    """Return a prefix that no other test uses."""
    return f"/rce{next(_numbers)}"


async def compact(etcd: Cluster, revision: int) -> None:
    url = f"http://{etcd.endpoints[0]}/v3/kv/compaction"
    async with (
        aiohttp.ClientSession() as session,
        session.post(url, json={"revision": str(revision), "physical": True}) as reply,
    ):
        assert reply.status == 200, await reply.text()


async def lead(client: EtcdClient, prefix: str, *, remaining: float = 60.0) -> tuple[EtcdStore, int, int]:
    """Take the lead; return the store, its term and its lease."""
    lease, _ = await client.grant(60)
    store = EtcdStore(client, prefix, Candidacy(lease, "one:9000", lambda: remaining))
    return store, await store.begin_term(), lease


async def test_etcd_store_obeys_the_laws_of_stores(client: EtcdClient, prefix: str) -> None:
    for number, check in enumerate((check_round_trip, check_terms, check_snapshot)):
        own = f"{prefix}/{number}"
        await prepare(client, own)
        await check(EtcdStore(client, own))


async def test_a_leading_store_obeys_them_too(client: EtcdClient, prefix: str) -> None:
    await prepare(client, prefix)
    lease, _ = await client.grant(60)
    await check_snapshot(EtcdStore(client, prefix, Candidacy(lease, "one:9000", lambda: 60.0)))


async def test_a_second_leader_is_refused_while_the_first_one_leads(client: EtcdClient, prefix: str) -> None:
    first, term, lease = await lead(client, prefix)
    with pytest.raises(StoreBusyError, match="another master leads: one:9000"):
        await lead(client, prefix)
    with pytest.raises(StoreBusyError):
        await EtcdStore(client, prefix).begin_term()
    assert (found := (await EtcdStore(client, prefix).leadership()).leader) is not None
    assert (found.name, found.term) == ("one:9000", term)
    await client.revoke(lease)
    assert not await first.holds_lead()
    second, newer, _ = await lead(client, prefix)
    assert newer == term + 1
    assert await second.holds_lead()


async def test_a_leader_without_its_lease_writes_nothing(client: EtcdClient, prefix: str) -> None:
    store, term, lease = await lead(client, prefix)
    await store.save([Row("users", "a", b"1")], term)
    await client.revoke(lease)
    with pytest.raises(FencedError, match="lease of this master's leadership has ended"):
        await store.save([Row("users", "a", b"2")], term)
    with pytest.raises(FencedError, match="not known"):
        await store.save([Row("users", "a", b"3")], term)
    other, newer, _ = await lead(client, prefix)
    with pytest.raises(StaleTermError, match="another master has taken over"):
        await other.save([Row("users", "a", b"4")], term)
    assert await other.load() == {"users": {"a": b"1"}}
    await other.save([Row("users", "a", b"5")], newer)
    assert await other.load() == {"users": {"a": b"5"}}


async def test_two_stores_of_one_lease_do_not_write_beside_each_other(
    client: EtcdClient, prefix: str
) -> None:
    """As after a fork of the process, or a bug: the save number tells."""
    store, term, _ = await lead(client, prefix)
    await store.save([Row("users", "a", b"1")], term)
    await client.transact([], [Put(Keys(prefix).last, b"1:7")])
    with pytest.raises(FencedError, match="the last save is 1:7"):
        await store.save([Row("users", "a", b"2")], term)
    assert await store.load() == {"users": {"a": b"1"}}


async def test_a_save_whose_answer_is_lost_is_found_to_be_done(etcd: Cluster, prefix: str) -> None:
    proxy = CuttingProxy(etcd.endpoints[0])
    async with proxy.running(), EtcdClient([proxy.endpoint], attempt=20.0) as client:
        store, term, _ = await lead(client, prefix)
        for number in range(20):
            proxy.cut("/v3/kv/txn", number % 4)
            await store.save([Row("users", "a", str(number).encode()), Row("log", str(number), b"")], term)
        assert proxy.cuts == 30
        found = await store.load()
        assert found["users"] == {"a": b"19"}
        assert len(found["log"]) == 20


async def test_a_term_whose_answer_is_lost_is_begun_once(etcd: Cluster, prefix: str) -> None:
    proxy = CuttingProxy(etcd.endpoints[0])
    async with proxy.running(), EtcdClient([proxy.endpoint], attempt=20.0) as client:
        proxy.cut("/v3/kv/txn", 1)
        store, term, _ = await lead(client, prefix)
        assert (term, proxy.cuts) == (1, 1)
        await store.save([Row("users", "a", b"1")], term)


async def test_a_save_without_an_answer_until_the_deadline_is_fenced(etcd: Cluster, prefix: str) -> None:
    """It was stored; the master does not know, so it may neither answer nor take it back."""
    proxy = CuttingProxy(etcd.endpoints[0])
    async with proxy.running(), EtcdClient([proxy.endpoint], attempt=20.0) as client:
        store, term, _ = await lead(client, prefix, remaining=0.0)
        proxy.cut("/v3/kv/txn", 1)
        with pytest.raises(FencedError, match="not known whether a save was stored"):
            await store.save([Row("users", "a", b"1")], term)
        assert await store.load() == {"users": {"a": b"1"}}


async def test_a_cancelled_save_ends_the_term(client: EtcdClient, prefix: str) -> None:
    store, term, _ = await lead(client, prefix)
    saving = asyncio.create_task(store.save([Row("users", "a", b"1")], term))
    await asyncio.sleep(0)
    saving.cancel()
    await asyncio.gather(saving, return_exceptions=True)
    with pytest.raises(FencedError, match="not known"):
        await store.save([Row("users", "a", b"2")], term)


async def test_a_save_that_is_too_large_is_refused(client: EtcdClient, prefix: str) -> None:
    store, term, _ = await lead(client, prefix)
    with pytest.raises(SaveTooLargeError, match="start etcd with --max-request-bytes"):
        await store.save([Row("users", "a", b"1" * (2 << 20))], term)
    await store.save([Row("users", "b", b"1")], term)
    assert await store.load() == {"users": {"b": b"1"}}


async def test_a_save_of_many_rows_is_one_transaction(etcd: Cluster, prefix: str) -> None:
    """More than etcd allows at one level; a member has the time that it takes to read the request."""
    rows = {f"anna/robot/interface{number}": b"1" for number in range(5000)}
    async with EtcdClient(etcd.endpoints, attempt=0.2) as client:
        store, term, lease = await lead(client, prefix)
        await store.save([Row("interfaces", key, body) for key, body in rows.items()], term)
        loaded, revision = await load_rows(client, Keys(prefix))
        assert loaded == {"interfaces": rows}
        await store.save([Row("interfaces", key, None) for key in rows], term)
        assert await load_rows(client, Keys(prefix)) == ({}, revision + 1)
        await client.revoke(lease)
        with pytest.raises(FencedError, match="lease of this master's leadership has ended"):
            await store.save([Row("interfaces", key, body) for key, body in rows.items()], term)
        assert await store.load() == {}


async def test_the_state_is_read_anew_if_it_is_compacted_meanwhile(
    etcd: Cluster, client: EtcdClient, prefix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, term, _ = await lead(client, prefix)
    rows = {f"{number:04d}": b"1" for number in range(700)}
    await store.save([Row("users", key, body) for key, body in rows.items()], term)
    read, reads = client.range, itertools.count(1)

    async def read_and_compact(prefix: str, **options: int) -> object:
        page = await read(prefix, **options)  # type: ignore[arg-type]
        if next(reads) == 1:
            await store.save([Row("users", "0000", b"2")], term)
            await compact(etcd, (await read(prefix, limit=1)).revision)
        return page

    monkeypatch.setattr(client, "range", read_and_compact)
    assert await store.load() == {"users": rows | {"0000": b"2"}}
    assert next(reads) == 4


async def test_the_first_user_is_added_before_a_master_leads(
    etcd: Cluster, client: EtcdClient, prefix: str, tmp_path: Path
) -> None:
    store = f"{etcd.store}{prefix}"
    add = ("add", "anna", "--admin", "--password-stdin", "--store", store)
    assert f"added anna in {store}" in await rce(tmp_path, "user", *add, text="secret\nsecret\n")
    assert list((await EtcdStore(client, prefix).load())["users"]) == ["anna"]
    _, _, lease = await lead(client, prefix)
    told = await rce(tmp_path, "user", *add, text="secret\nsecret\n", code=1)
    assert "another master leads: one:9000; to work over its API, log in there" in told
    await client.revoke(lease)
    told = await rce(tmp_path, "user", *add[:-1], "etcd://", text="secret\nsecret\n", code=1)
    assert "--store must name members of etcd" in told


async def test_check_tells_of_a_full_database(etcd: Cluster, client: EtcdClient, prefix: str) -> None:
    """Nothing has to be written for it: reads are answered as before."""
    await prepare(client, prefix)
    store, term, _ = await lead(client, prefix)
    await store.check()
    await etcd.set_alarm(on=True)
    try:
        with pytest.raises(StoreError, match=r"database space exceeded.*alarm disarm"):
            await store.check()
        with pytest.raises(StoreError, match=r"database space exceeded.*alarm disarm"):
            await store.save([], term)
    finally:
        await etcd.set_alarm(on=False)
    await store.save([], term)
    await store.check()
