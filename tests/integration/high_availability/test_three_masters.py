"""Three masters on an etcd of three members, and what they do when one of them or of etcd fails."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import pytest_asyncio
from msgspec.structs import replace
from support.engine import until
from support.etcd import Cluster, cluster
from support.masters import DEV_USER, MasterProcess, Masters, masters
from support.ports import free_port
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from rce.config import Secret
from rce.control import decode_to_task_set, encode
from rce.control.messages import (
    CONTROL_VERSION,
    Hello,
    MachineInfo,
    Refused,
    Sync,
    TaskSetKind,
    ToTaskSet,
    Welcome,
)
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.terms import Terms
from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

LEASE_S = 10.0
"""Of a loaded machine: a leader that etcd keeps waiting for some seconds still leads."""
SECRET = "a secret for the tests"
AUTHORIZATION = {"Authorization": f"Bearer {SECRET}"}


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def etcd(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Cluster]:
    async with cluster(tmp_path_factory.mktemp("etcd"), 3) as made:
        yield made


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_masters(etcd: Cluster, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Masters]:
    async with masters(tmp_path_factory.mktemp("masters"), etcd.store, lease=LEASE_S) as made:
        yield made


async def restart(master: MasterProcess) -> None:
    await master.start(ready="rce-master stand-by: ")


async def test_one_leads_and_the_others_say_who(shared_masters: Masters) -> None:
    found = await until(lambda: agreed(shared_masters), timeout=120, what="all masters agree who leads")
    leader = await shared_masters.leader()
    assert found["leader"] == f"{leader.name}:{leader.http_port}"
    async with shared_masters.session(20.0) as session:
        for other in (master for master in shared_masters.all if master is not leader):
            async with session.get(f"{other.url}healthz") as reply:
                assert (reply.status, reply.headers["Retry-After"]) == (503, "1")
            async with session.get(f"{other.url}metrics") as reply:
                told = await reply.text()
            assert "rce_master_leading 0.0" in told
            assert f"rce_master_term {float(found['term'])}" in told
            with pytest.raises(OSError, match=r"Connect call failed|refused"):
                await asyncio.open_connection("127.0.0.1", other.control_port)
        async with session.get(f"{leader.url}metrics") as reply:
            told = await reply.text()
        assert "rce_master_leading 1.0" in told
        assert f"rce_master_term {float(found['term'])}" in told


async def test_clients_with_all_addresses_find_the_leader(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    client = ApiClient(
        ",".join(master.url for master in (standby, *shared_masters.all)), shared_masters.token
    )
    async with client:
        assert [user["name"] for user in await client.items("/users")] == [DEV_USER]


async def test_a_stand_by_forwards_what_it_is_asked(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    api = f"{standby.url}api/v1"
    async with shared_masters.session(20.0) as session:
        async with session.get(f"{api}/users") as reply:
            assert [user["name"] for user in (await reply.json())["users"]] == [DEV_USER]
        async with session.post(f"{api}/robot-tokens", json={"robot": "through_another"}) as reply:
            assert reply.status == 201
        async with session.get(f"{api}/nothing", params={"a": "b/c d"}) as reply:
            assert (reply.status, "error" in await reply.json()) == (404, True)
        async with session.get(f"{standby.url}?userID={DEV_USER}&version=20130902") as reply:
            assert (reply.status, "No robot process is free" in await reply.text()) == (503, True)
        query = {"key": "0" * 64, "signature": "0" * 128}
        body = b"x" * 500_000
        async with session.put(f"{api}/packages/pkg/1.0.0", params=query, data=body) as reply:
            assert (reply.status, "is not registered" in await reply.text()) == (403, True)
        async with session.get(f"{api}/events", params={"since": 0}) as reply:
            assert reply.headers["Content-Type"] == "text/event-stream"
            lines = [await reply.content.readline() for _ in range(5)]
            assert lines[:3] == [b"id: 0\n", b": hello\n", b"\n"]
            assert lines[4].startswith(b"event: ")
    assert "through_another" in await shared_masters.stored()


async def test_what_a_stand_by_does_not_forward(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    users = f"{standby.url}api/v1/users"
    async with shared_masters.session(20.0) as session:
        async with session.get(users, headers={"Host": "evil.example"}) as reply:
            assert reply.status == 421
        async with session.get(users, headers={"Origin": "http://evil.example"}) as reply:
            assert reply.status == 403
        async with session.get(users, headers={"Origin": standby.url.rstrip("/")}) as reply:
            assert reply.status == 200, "of a page of the stand-by itself"
        async with session.get(users, headers={"RCE-Forwarded": "10.0.0.1 1 00"}) as reply:
            assert (reply.status, "asked by another stand-by" in await reply.text()) == (503, True)
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await session.ws_connect(f"{standby.url}api/v1/containers/c/exec")


async def test_a_websocket_is_opened_at_the_leader(shared_masters: Masters) -> None:
    """By a client that knows a stand-by only, or an address at which there is no master first."""
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    nowhere = f"http://127.0.0.1:{free_port()}/"
    for urls in (standby.url, f"{nowhere},{standby.url}", f"{nowhere},{leader.url}"):
        async with ApiClient(urls, shared_masters.token) as client:
            with pytest.raises(ApiError, match="nothing") as caught:
                async with client.websocket("/containers/nothing/exec", {}, 1000):
                    pytest.fail("there is no such container")
            assert caught.value.status == 404


async def test_the_leader_knows_who_asked_a_stand_by(shared_masters: Masters) -> None:
    """By a word that only masters can give: a client that claims to be another one is not believed."""
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    claim = {"RCE-Forwarded": "10.0.0.1 1 00"}
    for own, url, headers in (("127.0.0.8", standby.url, {}), ("127.0.0.9", leader.url, claim)):
        connector = aiohttp.TCPConnector(local_addr=(own, 0))
        body = {"userID": DEV_USER, "password": "wrong"}
        async with (
            aiohttp.ClientSession(connector=connector) as session,
            session.post(f"{url}api/v1/login", json=body, headers=headers) as reply,
        ):
            assert reply.status == 401
    async with shared_masters.session(20.0) as session, session.get(f"{leader.url}api/v1/audit") as reply:
        records = (await reply.json())["records"]
    refused = [record["address"] for record in records if record["outcome"] == "refused"]
    refused = [address for address in refused if address != "127.0.0.1"]  # of the test before
    assert refused == ["127.0.0.8", "127.0.0.9"]


async def test_a_task_set_finds_the_new_leader(shared_masters: Masters) -> None:
    """It knows all masters, of which only the leader listens for task sets."""
    syncs: asyncio.Queue[Sync] = asyncio.Queue()

    async def take(message: ToTaskSet) -> None:
        if isinstance(message, Sync):
            syncs.put_nowait(message)

    urls = ",".join(f"ws://127.0.0.1:{master.control_port}/" for master in shared_masters.all)
    running = asyncio.create_task(TaskSetChannel(urls, Secret(SECRET), hello, take).run())
    try:
        await asyncio.wait_for(syncs.get(), 120)
        leader = await shared_masters.leader()
        assert await leader.stop() == 0
        await asyncio.wait_for(syncs.get(), 120)
        await restart(leader)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def agreed(shared_masters: Masters) -> dict[str, Any] | None:
    """Return the answer of the leader if it leads, and the others say so."""
    leading, *others = sorted(
        [await master.health() for master in shared_masters.all], key=lambda told: told.get("role", "")
    )
    if leading.get("role") != "leader" or any(told.get("role") != "standby" for told in others):
        return None
    assert (leading["code"], leading["live"], leading["ready"]) == (200, True, True)
    assert leading["term"] > 0
    for told in others:
        assert (told["code"], told["live"], told["ready"]) == (503, True, False)
    who = (leading["leader"], leading["term"])
    return leading if all((told["leader"], told["term"]) == who for told in others) else None


async def test_nothing_acknowledged_is_lost_when_the_leader_is_killed(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    term = (await leader.health())["term"]
    async with shared_masters.under_load():
        await shared_masters.wait_for_writes()
        await leader.kill()
        new = await shared_masters.leader(but=leader)
        assert (await new.health())["term"] > term
        await shared_masters.wait_for_writes()
    await restart(leader)
    await shared_masters.check_nothing_is_lost()


async def ask_for_token(
    session: aiohttp.ClientSession, url: str, key: dict[str, str]
) -> tuple[int, str, str | None]:
    """Ask a master for a token, again while it does not know yet who leads."""
    async with asyncio.timeout(60):
        while True:
            async with session.post(f"{url}api/v1/tokens", json={"scope": "fleet"}, headers=key) as reply:
                if reply.status != 503:
                    return reply.status, await reply.text(), reply.headers.get("Idempotent-Replayed")
            await asyncio.sleep(0.2)


async def test_a_request_repeated_at_the_next_leader_is_done_once(shared_masters: Masters) -> None:
    """The key and its answer are stored with what the request did, so the next leader knows them."""
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    key = {"Idempotency-Key": '"a key"'}
    answers = []
    async with shared_masters.session(20.0) as session:
        for killed in (None, leader):
            if killed is not None:
                await killed.kill()
                await shared_masters.leader(but=killed)
            answers.append(await ask_for_token(session, standby.url, key))
    await restart(leader)
    (status, text, _), again = answers
    assert status == 201, text
    assert again == (201, text, "true")


async def test_sigterm_hands_over_before_the_lease_ends(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    term = (await leader.health())["term"]
    async with shared_masters.under_load():
        await shared_masters.wait_for_writes()
        assert await leader.stop() == 0
        new = await shared_masters.leader(but=leader)
        assert (await new.health())["term"] > term
        await shared_masters.wait_for_writes()
    assert "left to end by itself" not in leader.output()
    await restart(leader)
    await shared_masters.check_nothing_is_lost()


async def drain(shared_masters: Masters, name: str, *, drained: bool = True) -> list[dict[str, Any]]:
    leader = await shared_masters.leader()
    url = f"{leader.url}api/v1/machines/{name}/drain"
    async with (
        shared_masters.session(20.0) as session,
        session.request("PUT" if drained else "DELETE", url) as reply,
    ):
        assert reply.status == 200, await reply.text()
        found: list[dict[str, Any]] = (await reply.json())["masters"]
        return found


async def test_a_drained_leader_hands_over(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    name = f"{leader.name}:{leader.http_port}"
    async with shared_masters.under_load():
        await shared_masters.wait_for_writes()
        (told,) = await drain(shared_masters, name)
        assert (told["name"], told["role"], told["drained"]) == (name, "leader", True)
        new = await shared_masters.leader(but=leader)
        await shared_masters.wait_for_writes()
    await until(
        lambda: shows(leader, role="standby", drained=True), timeout=120, what="it stands by, drained"
    )
    assert await shows(new, role="leader", drained=False)
    await shared_masters.check_nothing_is_lost()
    url = f"{new.url}api/v1/masters"
    async with shared_masters.session(20.0) as session, session.get(url) as reply:
        listed = (await reply.json())["masters"]
    assert {one["name"]: (one["role"], one["drained"]) for one in listed} == {
        f"{one.name}:{one.http_port}": ("leader" if one is new else "standby", one is leader)
        for one in shared_masters.all
    }
    # It leads only as long as no other one can.
    others = [one for one in shared_masters.all if one is not leader]
    for other in others:
        await other.kill()
    assert await shared_masters.leader() is leader
    assert await shows(leader, role="leader", drained=True)
    for other in others:
        await restart(other)
    assert await shared_masters.leader(but=leader) in others
    (told,) = await drain(shared_masters, name, drained=False)
    assert not told["drained"]
    await until(lambda: shows(leader, role="standby", drained=False), timeout=120, what="the drain has ended")


async def test_audit_log_of_all_terms(shared_masters: Masters) -> None:
    former = await shared_masters.leader()
    await note(former, shared_masters, "before")
    (last,) = await audit(former, shared_masters, since=-1)
    await former.kill()
    leader = await shared_masters.leader(but=former)
    await note(leader, shared_masters, "after")
    found = await audited(leader, shared_masters, since=-1000)
    assert [why.partition(":")[0] for why in found["missing"]] == [former.name]
    await restart(former)

    async def complete() -> list[dict[str, Any]] | None:
        found = await audited(leader, shared_masters, since=-1000)
        return None if found["missing"] else list(found["records"])

    records = await until(complete, timeout=120, what="the former leader gives its records")
    ids = [record["id"] for record in records]
    assert ids == sorted(set(ids))
    noted = [record["subject"] for record in records if record["action"] == "note"]
    assert noted[-2:] == ["before", "after"]
    newer = await audit(leader, shared_masters, since=last["id"])
    assert newer == records[ids.index(last["id"]) + 1 :]
    assert [one["subject"] for one in newer if one["action"] == "note"] == ["after"]
    assert await audit(leader, shared_masters, since=-1, user="nobody") == []


async def note(master: MasterProcess, shared_masters: Masters, subject: str) -> None:
    body = {"action": "note", "subject": subject}
    async with (
        shared_masters.session(20.0) as session,
        session.post(f"{master.url}api/v1/audit", json=body) as reply,
    ):
        assert reply.status == 204, await reply.text()


async def audited(master: MasterProcess, shared_masters: Masters, **query: str | int) -> dict[str, Any]:
    async with (
        shared_masters.session(20.0) as session,
        session.get(f"{master.url}api/v1/audit", params=query) as reply,
    ):
        found: dict[str, Any] = await reply.json()
        assert reply.status == 200, found
        return found


async def audit(master: MasterProcess, shared_masters: Masters, **query: str | int) -> list[dict[str, Any]]:
    return list((await audited(master, shared_masters, **query))["records"])


async def shows(master: MasterProcess, **expected: object) -> bool:
    found = await master.health()
    return all(found.get(key) == value for key, value in expected.items())


async def test_a_drain_of_what_is_not_there(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    url = f"{leader.url}api/v1/machines/nowhere:9000/drain"
    async with shared_masters.session(20.0) as session, session.put(url) as reply:
        assert (reply.status, "no machine or task set" in await reply.text()) == (404, True)


async def test_the_next_leader_has_followed_the_state(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    for other in (one for one in shared_masters.all if one is not leader):
        await until(lambda: shows(other, lag=0.0, lag_revisions=0), timeout=120, what="it has no lag")  # noqa: B023
        async with shared_masters.session(20.0) as session, session.get(f"{other.url}metrics") as reply:
            told = await reply.text()
        assert "rce_master_lag_seconds 0.0" in told
        assert "rce_master_lag_revisions 0.0" in told
    assert await leader.stop() == 0
    new = await shared_masters.leader(but=leader)
    assert "the state was followed: of " in new.output()
    await restart(leader)
    await shared_masters.check_nothing_is_lost()


async def test_a_master_of_another_engine_is_refused(
    shared_masters: Masters, etcd: Cluster, tmp_path: Path
) -> None:
    stranger = MasterProcess(tmp_path, "stranger", etcd.store, LEASE_S)
    stranger.env = {**stranger.env, "RCE_SECRET": "the secret of another engine"}
    with pytest.raises(AssertionError, match="ended with 1"):
        await stranger.start(ready="rce-master stand-by: ")
    assert "below /rce/ of etcd is the state of another engine" in stranger.output()
    assert (await (await shared_masters.leader()).health())["role"] == "leader"


async def test_a_stopped_leader_says_and_does_nothing_when_it_wakes(shared_masters: Masters) -> None:
    """Requests that wait in its sockets, and a task set that is connected, get nothing of the old term."""
    leader = await shared_masters.leader()
    control = f"ws://127.0.0.1:{leader.control_port}/"
    async with (
        shared_masters.session(60.0) as session,
        connect(control, additional_headers=AUTHORIZATION) as task_set,
    ):
        async with session.get(f"{leader.url}api/v1/users") as reply:
            assert reply.status == 200  # the next request finds an open connection
        await task_set.send(encode(hello()))
        async for frame in task_set:
            if isinstance(decode_to_task_set(frame), Sync):
                break
        async with shared_masters.under_load():
            await shared_masters.wait_for_writes()
            said = len(leader.output())
            leader.send(signal.SIGSTOP)
            reads = [
                asyncio.create_task(status(session, "GET", f"{leader.url}api/v1/users")) for _ in range(4)
            ]
            body = {"robot": "of_the_old_term"}
            write = asyncio.create_task(status(session, "POST", f"{leader.url}api/v1/robot-tokens", body))
            dial = asyncio.create_task(handshake(control))
            new = await shared_masters.leader(but=leader)
            await shared_masters.wait_for_writes()
        leader.send(signal.SIGCONT)
        assert await dial is False
        assert {*await asyncio.gather(*reads), await write} <= {503, 0}
        with pytest.raises(ConnectionClosed):
            pytest.fail(f"the old leader sent {await task_set.recv()!r}")
    await until(
        lambda: "rce-master stand-by: " in leader.output()[said:], what="the old leader is a stand-by"
    )
    assert "leads no more" in leader.output()[said:]
    assert (await new.health())["role"] == "leader"
    assert "of_the_old_term" not in await shared_masters.stored()
    await shared_masters.check_nothing_is_lost()


async def test_nothing_acknowledged_is_lost_when_etcds_leader_is_killed(
    shared_masters: Masters, etcd: Cluster
) -> None:
    async with shared_masters.under_load():
        await shared_masters.wait_for_writes()
        member = await etcd.leader()
        member.send(signal.SIGKILL)
        await shared_masters.wait_for_writes(20)
        await member.start(etcd.members)
        await shared_masters.wait_for_writes(20)
    await shared_masters.check_nothing_is_lost()


async def test_the_term_grows_above_what_a_task_set_has_seen(shared_masters: Masters) -> None:
    """As after etcd was restored from an older copy: else the task set would listen to no master."""
    term = (await (await shared_masters.leader()).health())["term"]
    seen = asyncio.Queue[int]()

    async def take(message: ToTaskSet) -> None:
        if isinstance(message, Welcome):
            seen.put_nowait(message.term)

    urls = ",".join(f"ws://127.0.0.1:{master.control_port}/" for master in shared_masters.all)
    terms = Terms(term + 100)
    running = asyncio.create_task(TaskSetChannel(urls, Secret(SECRET), hello, take, terms=terms).run())
    try:
        new = await asyncio.wait_for(seen.get(), 120)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert new > term + 100
    assert terms.newest == new


async def test_a_term_far_ahead_is_not_believed(shared_masters: Masters) -> None:
    leader = await shared_masters.leader()
    control = f"ws://127.0.0.1:{leader.control_port}/"
    async with connect(control, additional_headers=AUTHORIZATION) as task_set:
        await task_set.send(encode(replace(hello(), term=10**12)))
        refusal = decode_to_task_set(await task_set.recv())
    assert isinstance(refusal, Refused)
    assert "which is not believed" in refusal.reason
    assert (await leader.health())["role"] == "leader"


def hello() -> Hello:
    return Hello(
        version=CONTROL_VERSION, kind=TaskSetKind.CONTAINER, process="c1", machine=MachineInfo(name="machine")
    )


async def status(session: aiohttp.ClientSession, method: str, url: str, body: object = None) -> int:
    """Return the status of an answer; 0 if there is none."""
    try:
        async with session.request(method, url, json=body) as reply:
            return reply.status
    except (aiohttp.ClientError, TimeoutError):
        return 0


async def handshake(url: str) -> bool:
    """Dial as a task set; return whether the master took it."""
    try:
        async with connect(url, additional_headers=AUTHORIZATION, open_timeout=60):
            return True
    except (InvalidHandshake, OSError, TimeoutError):
        return False
