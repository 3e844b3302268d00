"""The client of etcd and what it says of an etcd that cannot be used."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from pathlib import Path

import pytest
from aiohttp import web
from support.engine import until
from support.etcd import Cluster, cluster
from support.go_between import LOOPBACK
from support.masters import MasterProcess
from support.ports import free_port

from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce_master import replicated
from rce_master.exceptions import StoreError
from rce_master.leadership.keeper import LeadershipKeeper
from rce_master.store import Row
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.client import LOAD_S
from rce_master.store.etcd.exceptions import EtcdAwayError, NoQuorumError
from rce_master.store.etcd.layout import Keys, prepare
from rce_master.store.etcd.wire import Put

PATIENT_S = 20.0
NEVER_S = 600.0
"""Longer than a test takes."""
HEADER = {"header": {"revision": "7"}}
EXPIRES_AT_ONCE = 1 / 86400
"""Days."""


@contextlib.asynccontextmanager
async def other_server(answers: dict[str, object]) -> AsyncIterator[str]:
    """Serve JSON at some paths, as programs do that are not etcd, or an old one."""

    async def answer(request: web.Request) -> web.Response:
        if request.path not in answers:
            return web.Response(status=404, text="Not Found\n")
        return web.json_response(answers[request.path])

    async with served(answer) as endpoint:
        yield endpoint


@contextlib.asynccontextmanager
async def served(answer: Callable[[web.Request], Awaitable[web.StreamResponse]]) -> AsyncIterator[str]:
    """Serve the answers of a function; give the address."""
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", answer)
    runner = web.AppRunner(app)
    await runner.setup()
    port = free_port()
    await web.TCPSite(runner, LOOPBACK, port).start()
    try:
        yield f"{LOOPBACK}:{port}"
    finally:
        await runner.cleanup()


@contextlib.asynccontextmanager
async def silent_server() -> AsyncIterator[tuple[str, list[bytes]]]:
    """Take connections and what they send, and never answer; give the address and what was read."""
    read: list[bytes] = []

    async def never_answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.closing(writer):
            while piece := await reader.read(1 << 16):
                read.append(piece)

    async with await asyncio.start_server(never_answer, LOOPBACK, 0) as server:
        host, port = server.sockets[0].getsockname()
        yield f"{host}:{port}", read


async def refusal(endpoint: str, prefix: str = "/rce", *, attempt: float = PATIENT_S) -> str:
    """Return what :func:`prepare` says."""
    async with EtcdClient([endpoint], attempt=attempt) as client:
        with pytest.raises(StoreError) as caught:
            await prepare(client, prefix)
    return str(caught.value)


async def test_a_port_without_a_server_is_named() -> None:
    endpoint = f"{LOOPBACK}:{free_port()}"
    text = await refusal(endpoint)
    assert endpoint in text
    assert "refused" in text.lower()


async def test_a_server_that_is_not_etcd_is_named() -> None:
    async with other_server({"/version": {"rce": "0.1"}}) as endpoint:
        assert f"{endpoint}: this is not etcd" in await refusal(endpoint)
    async with other_server({}) as endpoint:
        assert f"{endpoint}: this is not etcd" in await refusal(endpoint)


async def test_an_etcd_before_the_gateway_is_refused() -> None:
    async with other_server({"/version": {"etcdserver": "3.3.27", "etcdcluster": "3.3.0"}}) as endpoint:
        assert "is version 3.3; version 3.4 or later is needed" in await refusal(endpoint)


@pytest.mark.needs("etcd")
async def test_a_prefix_of_another_program_or_release_is_left_alone(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await client.transact([], [Put("/other/key", b"1"), Put(Keys("/newer").schema, b"99")])
        text = await refusal(etcd.endpoints[0], "/other")
        assert "keys of another program below /other/, such as '/other/key'" in text
        text = await refusal(etcd.endpoints[0], "/newer")
        assert "has version 99, this program reads version 2: install the release that wrote it" in text
        assert "restore a backup" in text
        await prepare(client, "/rce")
        await prepare(client, "/rce")
        keys = [record.key for record in (await client.range("/")).records]
        assert keys == ["/newer/schema", "/other/key", "/rce/schema"]


@pytest.mark.needs("etcd")
async def test_an_etcd_with_its_default_limits_is_refused(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd", 1, "--max-txn-ops", "128") as etcd:
        assert "start etcd with --max-txn-ops 4096" in await refusal(etcd.endpoints[0])


@pytest.mark.needs("etcd")
async def test_a_master_without_its_control_port_ends(tmp_path: Path) -> None:
    """It is refused once it leads; it gives the lead back, so that another master takes it at once."""
    async with cluster(tmp_path / "etcd") as etcd:
        master = MasterProcess(tmp_path, "one", etcd.store, 5.0)
        with socket.create_server((LOOPBACK, master.control_port)):
            await master.start(ready="rce-master stand-by: ")
            assert master.process is not None
            assert await master.process.wait() == 1
        assert "--control-port" in master.output().splitlines()[-1]
        async with EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
            assert (await EtcdStore(client, "/rce").leadership()).leader is None


@pytest.mark.needs("etcd")
async def test_members_that_fail_are_passed_over(tmp_path: Path) -> None:
    """One is killed, one is stopped: the third alone has no quorum, and says so; with two all is well."""
    async with cluster(tmp_path / "etcd", 3) as etcd, EtcdClient(etcd.endpoints, attempt=1.0) as client:
        await prepare(client, "/rce")
        store = EtcdStore(client, "/rce")
        first = await etcd.leader()
        first.send(signal.SIGKILL)
        second = await etcd.leader_of([member for member in etcd.members if member is not first])
        await store.save([Row("users", "a", b"1")])
        second.send(signal.SIGSTOP)
        (third,) = [member for member in etcd.members if member not in (first, second)]
        text = await refusal(third.endpoint)
        assert "etcd has no quorum" in text
        assert "rce cluster recover" in text
        await check_runtime_faults(client)
        second.send(signal.SIGCONT)
        await etcd.leader_of([second, third])
        await store.save([Row("users", "b", b"2")])
        assert await store.load() == {"users": {"a": b"1", "b": b"2"}}


@pytest.mark.needs("etcd")
async def test_a_silent_member_holds_no_look_at_the_lead(etcd: Cluster) -> None:
    """It was cut off with its machine: connections to it are there, and nothing comes back."""
    async with silent_server() as (silent, read):
        endpoints = [silent, *etcd.endpoints]
        async with EtcdClient(endpoints, attempt=0.2) as client, asyncio.timeout(LOAD_S / 2):
            assert (await EtcdStore(client, "/silent").leadership()).leader is None
    assert read


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(lambda client: client.transact([], [Put("/a", b"a" * 1_000_000)]), id="save"),
        pytest.param(lambda client: client.range("/", timeout=NEVER_S), id="page"),
        pytest.param(lambda client: client.grant(5), id="lease"),
    ],
)
async def test_calls_leave_a_member_that_was_passed_over(
    call: Callable[[EtcdClient], Coroutine[object, object, object]],
) -> None:
    """A large save or a page, which may take long, ends with the next member once a small request failed."""
    answers = {
        "/v3/kv/txn": {**HEADER, "succeeded": True},
        "/v3/kv/range": HEADER,
        "/v3/lease/grant": {"ID": "1", "TTL": "5"},
    }
    async with (
        silent_server() as (silent, read),
        other_server(answers) as other,
        EtcdClient([silent, other], attempt=NEVER_S) as client,
    ):
        waiting = asyncio.create_task(call(client))
        await until(lambda: read, what="the silent member has got the request")
        await client.range("/", timeout=0.1)
        await asyncio.wait_for(waiting, PATIENT_S)


async def test_a_call_that_left_a_member_may_be_done() -> None:
    """The member may pass it on later, so that another one's refusal does not tell that nothing was done."""
    refused = {"error": "etcdserver: permission denied", "code": 7}
    answers = {"/v3/kv/txn": refused, "/v3/kv/range": HEADER}
    async with (
        silent_server() as (silent, read),
        other_server(answers) as other,
        EtcdClient([silent, other], attempt=NEVER_S) as client,
    ):
        saving = asyncio.create_task(client.transact([], [Put("/a", b"a")]))
        await until(lambda: read, what="the silent member has got the save")
        await client.range("/", timeout=0.1)
        with pytest.raises(EtcdAwayError, match="permission denied") as caught:
            await asyncio.wait_for(saving, PATIENT_S)
    assert caught.value.maybe_done


async def test_a_late_answer_counts_while_the_next_member_is_asked() -> None:
    """Where each member needs longer than one may take, etcd can still be used."""
    asked = 0
    both, ended = asyncio.Event(), asyncio.Event()

    async def far_away(_: web.Request) -> web.Response:
        nonlocal asked
        asked += 1
        number = asked
        if number == 1:
            await both.wait()
            return web.json_response({**HEADER, "count": "1"})
        both.set()
        await ended.wait()
        return web.json_response(HEADER)

    async with contextlib.AsyncExitStack() as stack:
        endpoints = [await stack.enter_async_context(served(far_away)) for _ in range(2)]
        async with EtcdClient(endpoints, attempt=NEVER_S) as client, asyncio.timeout(PATIENT_S):
            page = await client.range("/", timeout=0.1)
            assert page.count == 1
            assert client.in_use == endpoints[1]
        ended.set()


async def test_a_call_whose_answer_has_begun_stays() -> None:
    """A member that answers a page slowly is not asked in vain if a small request failed meanwhile."""
    may_end = asyncio.Event()
    began = asyncio.Event()

    async def answer_slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.closing(writer):
            await reader.readuntil(b"/range")
            page = json.dumps({**HEADER, "count": "9"}).encode()
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(page))
            began.set()
            await may_end.wait()
            writer.write(page)
            await writer.drain()

    async with await asyncio.start_server(answer_slowly, LOOPBACK, 0) as server, other_server({}) as other:
        host, port = server.sockets[0].getsockname()
        async with EtcdClient([f"{host}:{port}", other], attempt=NEVER_S) as client:
            reading = asyncio.create_task(client.range("/", timeout=NEVER_S))
            await began.wait()
            with pytest.raises(EtcdAwayError):
                await client.range("/", timeout=0.1)
            may_end.set()
            page = await asyncio.wait_for(reading, PATIENT_S)
    assert page.count == 9


async def test_all_members_are_asked_for_their_version_at_once() -> None:
    """One that is silent costs its time once, not once for each member that is asked after it."""
    asked: list[web.Request] = []
    both = asyncio.Event()

    async def version(request: web.Request) -> web.Response:
        asked.append(request)
        if len(asked) == len(endpoints):
            both.set()
        await both.wait()
        release = "3.3.27" if request.host == endpoints[0] else "3.4.23"
        return web.json_response({"etcdserver": release, "etcdcluster": release})

    async with contextlib.AsyncExitStack() as stack:
        endpoints = [await stack.enter_async_context(served(version)) for _ in range(2)]
        stack.callback(both.set)
        async with EtcdClient(endpoints, attempt=PATIENT_S) as client:
            with pytest.raises(StoreError, match=r"is version 3\.3"):
                await client.check_members()


@pytest.mark.needs("etcd")
async def test_a_member_without_a_version_is_not_asked_first(etcd: Cluster) -> None:
    async with (
        silent_server() as (silent, read),
        EtcdClient([silent, *etcd.endpoints], attempt=2.0) as client,
    ):
        await client.check_members()
        await client.get("/")
    assert b"GET /version" in b"".join(read)
    assert b"POST" not in b"".join(read)


async def test_a_start_without_a_quorum_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while one pass over the members takes longer than the start may."""
    monkeypatch.setattr(replicated, "START_TIMEOUT_S", 0.5)

    ended = asyncio.Event()

    async def without_quorum(request: web.Request) -> web.Response:
        if request.path != "/version":
            await ended.wait()
        return web.json_response({"etcdserver": "3.4.23", "etcdcluster": "3.4.0"})

    async with served(without_quorum) as endpoint, EtcdClient([endpoint], attempt=600.0) as client:
        try:
            with pytest.raises(NoQuorumError, match=r"etcd has no quorum.*0\.5 s.*rce cluster recover"):
                async with asyncio.timeout(60):
                    await replicated._prepare(client, "/rce")
        finally:
            ended.set()


@pytest.mark.needs("etcd")
async def test_a_silent_member_holds_no_watch(etcd: Cluster) -> None:
    """The next watch asks another member, whose answer comes before there is a change."""
    async with (
        silent_server() as (silent, read),
        EtcdClient([silent, *etcd.endpoints], attempt=2.0) as client,
    ):
        with pytest.raises(EtcdAwayError, match="no answer within 2 s"):
            async with asyncio.timeout(LOAD_S), client.watch("/silent/", 1):
                pytest.fail("it does not answer")
        async with client.watch("/silent/", 1) as watch:
            assert client.uses(watch)
    assert read


async def check_runtime_faults(client: EtcdClient) -> None:
    """What a leader and a stand-by show at ``/healthz`` names what to do when etcd has no quorum."""
    with pytest.raises(StoreError, match=r"more than half of the members.*rce cluster recover"):
        await EtcdStore(client, "/rce").check()
    keeper = LeadershipKeeper(client, "/rce", "one:9000")
    waiting = asyncio.create_task(keeper.acquire())
    try:
        await until(lambda: keeper.fault, timeout=60, what="the stand-by knows that etcd does not answer")
    finally:
        waiting.cancel()
        await asyncio.wait([waiting])
    assert "rce cluster recover" in keeper.fault


@pytest.mark.needs("etcd")
async def test_etcd_with_client_certificates(tmp_path: Path) -> None:
    folder = CertificateFolder(tmp_path / "certificates")
    folder.make_authority()
    folder.issue("engine", hosts=[LOOPBACK])
    certificate, key = folder.certificate("engine"), folder.key("engine")
    files = TlsFiles(certificate, key, folder.authority)
    options = [
        *("--cert-file", str(certificate), "--key-file", str(key)),
        *("--client-cert-auth", "--trusted-ca-file", str(folder.authority)),
    ]
    async with cluster(tmp_path / "etcd", 1, *options, tls=TlsIdentity(files).client) as etcd:
        async with EtcdClient(etcd.endpoints, tls=TlsIdentity(files).client, attempt=PATIENT_S) as client:
            await prepare(client, "/rce")
            await EtcdStore(client, "/rce").save([Row("users", "a", b"1")])
            assert await EtcdStore(client, "/rce").load() == {"users": {"a": b"1"}}
        without = TlsIdentity(TlsFiles(authority=folder.authority)).client
        async with EtcdClient(etcd.endpoints, tls=without, attempt=PATIENT_S) as client:
            with pytest.raises(EtcdAwayError):
                await client.check_members()
        assert "etcds://" in await refusal(etcd.endpoints[0])
        await check_master(tmp_path, f"etcds://{etcd.endpoints[0]}/own", "--certificates", str(folder.path))


@pytest.mark.needs("etcd")
async def test_an_expired_certificate_is_named_and_renewed(tmp_path: Path) -> None:
    """The client that found it expired uses the new one, and so does etcd."""
    folder = CertificateFolder(tmp_path / "certificates")
    folder.make_authority()
    for name in ("etcd", "long", "short"):
        folder.issue(name, hosts=[LOOPBACK])

    def identity(name: str) -> TlsIdentity:
        return TlsIdentity(TlsFiles(folder.certificate(name), folder.key(name), folder.authority))

    options = [
        *("--cert-file", str(folder.certificate("etcd")), "--key-file", str(folder.key("etcd"))),
        *("--client-cert-auth", "--trusted-ca-file", str(folder.authority)),
    ]
    async with (
        cluster(tmp_path / "etcd", 1, *options, tls=identity("long").client) as etcd,
        EtcdClient(etcd.endpoints, tls=identity("short").client, attempt=PATIENT_S) as client,
    ):
        for name, said in (
            ("short", "our certificate: it may have expired"),
            ("etcd", "the server's certificate has"),
        ):
            folder.issue(name, hosts=[LOOPBACK], days=EXPIRES_AT_ONCE)
            await until(lambda: folder.details(name).days_left() < 0, what="it has expired")  # noqa: B023
            async with EtcdClient(etcd.endpoints, tls=identity("short").client, attempt=PATIENT_S) as other:
                with pytest.raises(EtcdAwayError) as caught:
                    await other.get("/")
                assert said in str(caught.value)
                folder.issue(name, hosts=[LOOPBACK])
                await other.get("/")
        await client.get("/")


async def check_master(folder: Path, store: str, *options: str) -> None:
    """Let a master take the lead, and give it back."""
    master = MasterProcess(folder, "one", store, 5.0)
    master.argv += options
    await master.start(ready="rce-master ready: ")
    assert (await until(master.health, what="it answers"))["role"] == "leader"
    assert await master.stop() == 0
