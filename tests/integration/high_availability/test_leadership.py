"""Which of several keepers leads, on a real etcd."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

import pytest
from support.absent_masters import silent_master
from support.engine import until
from support.etcd import Cluster

from rce_master.exceptions import FencedError
from rce_master.leadership import LeaseSettings, Role
from rce_master.leadership.keeper import LeadershipKeeper, boot_time
from rce_master.store import Row
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.store import EtcdStore

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

PATIENT = LeaseSettings(ttl=30.0)
PREFIX = "/rce"


async def test_one_keeper_leads_and_hands_over_at_once(client: EtcdClient) -> None:
    first, second = (LeadershipKeeper(client, PREFIX, name, PATIENT) for name in ("one", "two"))
    store, fence = await first.acquire()
    await store.save([Row("users", "a", b"1")], fence.term)
    waiting = asyncio.create_task(second.acquire())
    await until(lambda: second.leader, what="the stand-by knows the leader")
    assert second.leader is not None
    assert (second.leader.name, second.leader.term, second.core.role) == ("one", fence.term, Role.STANDBY)
    began = boot_time()
    await first.step_down()
    assert (first.core.role, fence.is_closed) == (Role.STANDBY, True)
    newer, own = await waiting
    assert boot_time() - began < PATIENT.ttl  # not by the end of the lease
    assert own.term == fence.term + 1
    assert await newer.load() == {"users": {"a": b"1"}}
    with pytest.raises(FencedError):
        await store.save([Row("users", "a", b"2")], fence.term)
    await second.step_down()


async def test_silent_member_delays_the_end_of_a_lease_little(client: EtcdClient, etcd: Cluster) -> None:
    async with silent_master() as (url, asked):
        members = [urlsplit(url).netloc, *etcd.endpoints]
        async with EtcdClient(members, attempt=3600.0) as other:
            keeper = LeadershipKeeper(client, PREFIX, "one", PATIENT)
            await keeper.acquire()
            keeper._client = other
            async with asyncio.timeout(120):
                await keeper.step_down()
            assert asked.is_set()
            assert (await EtcdStore(client, PREFIX).leadership()).leader is None


async def test_of_many_keepers_one_leads(client: EtcdClient) -> None:
    keepers = [LeadershipKeeper(client, PREFIX, f"m{number}", PATIENT) for number in range(5)]
    terms = []
    tasks = {asyncio.create_task(keeper.acquire()): keeper for keeper in keepers}
    while tasks:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        assert len(done) == 1
        assert [keeper.core.role for keeper in keepers].count(Role.LEADING) == 1
        (task,) = done
        terms.append(task.result()[1].term)
        await tasks.pop(task).step_down()
    assert terms == list(range(terms[0], terms[0] + 5))


async def test_a_stand_by_that_ends_leaves_nothing(client: EtcdClient) -> None:
    leader, standby = (LeadershipKeeper(client, PREFIX, name, PATIENT) for name in ("one", "two"))
    await leader.acquire()
    waiting = asyncio.create_task(standby.acquire())
    await until(lambda: standby.leader, what="the stand-by knows the leader")
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    assert standby.core.role is Role.STANDBY
    await leader.step_down()
    third = LeadershipKeeper(client, PREFIX, "three", PATIENT)
    await third.acquire()
    await third.step_down()


async def test_a_lease_is_renewed_until_etcd_ends_it(client: EtcdClient) -> None:
    keeper = LeadershipKeeper(client, PREFIX, "one", LeaseSettings(ttl=6.0))
    _, fence = await keeper.acquire()
    keeping = asyncio.create_task(keeper.keep())
    before = keeper.core.deadline
    await until(lambda: keeper.core.deadline > before + 2.0, what="the lease is renewed")
    fence.check()
    await client.revoke(keeper.lease)
    with pytest.raises(FencedError, match="lease was lost"):
        await keeping
    assert fence.is_closed
    await keeper.step_down()


async def test_a_master_whose_clock_jumped_leads_no_more(client: EtcdClient) -> None:
    """As after a suspension of its machine: nothing has to come from etcd for it to know."""
    jump = 0.0
    keeper = LeadershipKeeper(client, PREFIX, "one", PATIENT, clock=lambda: boot_time() + jump)
    _, fence = await keeper.acquire()
    fence.check()
    jump = PATIENT.ttl
    with pytest.raises(FencedError, match="leads no more"):
        fence.check()
    with pytest.raises(FencedError):
        await keeper.keep()
    await keeper.step_down()


async def test_a_full_etcd_is_told_once_until_it_has_room(
    etcd: Cluster, client: EtcdClient, caplog: pytest.LogCaptureFixture
) -> None:
    """It answers each look and grants no lease; what a stand-by shows does not change from look to look."""
    keeper = LeadershipKeeper(client, "/full", "one", PATIENT)
    shown: list[str] = []

    def looked(_: int) -> None:
        shown.append(keeper.fault)
        keeper.wake()

    keeper.on_look = looked
    await etcd.set_alarm(on=True)
    waiting = asyncio.create_task(keeper.acquire())
    try:
        await until(lambda: len(shown) > 5, what="it has looked several times")
        assert all("database space exceeded" in fault for fault in shown[1:])
        assert caplog.text.count("database space exceeded") == 1
    finally:
        await etcd.set_alarm(on=False)
        await waiting
    assert keeper.fault == ""
    await keeper.step_down()
