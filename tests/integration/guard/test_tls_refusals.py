"""A server that demands certificates: what refused clients are told, in both event loops."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
import uvloop
from aiohttp import ClientSession, web
from support.cloud import SECRET, running_cloud
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from rce.control_channel.server import ControlServer
from rce.tls.faults import explain_to_client
from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce.tls.websocket import TlsClientConnection
from rce.web.server import HttpServer
from rce_client.discovery import locate
from rce_client.exceptions import UnavailableError

LOOPS = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
# libuv makes a pipe for signals with the first loop, and keeps it.
uvloop.new_event_loop().close()
HEADER = {"Authorization": f"Bearer {SECRET.reveal()}"}


async def nothing(*_: object) -> None:
    """Take what comes."""


class Site:
    """A control server in TLS, and the folder of its certificates."""

    def __init__(self, path: Path) -> None:
        self.folder = CertificateFolder(path)
        self.folder.make_authority()
        self.folder.issue("master", ("127.0.0.1",))
        identity = TlsIdentity(self.files("master"))
        self.server = ControlServer(
            SECRET,
            on_hello=nothing,
            on_message=nothing,
            on_gone=nothing,
            port=0,
            tls=identity.mutual_server,
            is_revoked=identity.is_revoked,
        )

    def files(self, name: str) -> TlsFiles:
        folder = self.folder
        return TlsFiles(folder.certificate(name), folder.key(name), folder.authority, folder.revoked)

    async def dial(self, files: TlsFiles) -> ClientConnection:
        return await connect(
            f"wss://127.0.0.1:{self.server.port}",
            additional_headers=HEADER,
            ssl=TlsIdentity(files).client(),
            create_connection=TlsClientConnection,
            proxy=None,
        )

    async def refusal(self, files: TlsFiles) -> str:
        with pytest.raises((InvalidHandshake, OSError)) as caught:
            await self.dial(files)
        return explain_to_client(caught.value) or f"unexplained: {caught.value!r}"


@pytest.mark.parametrize("loop", LOOPS)
def test_refused_client_learns_the_reason(loop: str, tmp_path: Path) -> None:
    """In TLS 1.3 its own handshake is done by then: the alert comes with its first read."""

    async def run() -> None:
        site = Site(tmp_path / "engine")
        other = CertificateFolder(tmp_path / "other")
        other.make_authority()
        other.issue("machine")
        foreign = TlsFiles(other.certificate("machine"), other.key("machine"), site.folder.authority)
        site.folder.issue("late", days=-1)
        site.folder.issue("stolen")
        async with site.server:
            without = TlsFiles(authority=site.folder.authority)
            assert "demands a certificate of its authority" in await site.refusal(without)
            assert "another authority issued it" in await site.refusal(foreign)
            assert "our certificate has expired" in await site.refusal(site.files("late"))
            await (await site.dial(site.files("stolen"))).close()
            site.folder.revoke("stolen")
            assert "our certificate was revoked" in await site.refusal(site.files("stolen"))
            site.folder.issue("stolen")
            await (await site.dial(site.files("stolen"))).close()

    with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
        runner.run(run())


async def test_connected_task_set_is_dropped_when_revoked(tmp_path: Path) -> None:
    """Others of the same authority stay."""
    site = Site(tmp_path)
    for name in ("stolen", "good"):
        site.folder.issue(name)
    async with site.server:
        stolen, good = [await site.dial(site.files(name)) for name in ("stolen", "good")]
        site.folder.revoke("stolen")
        with pytest.raises(ConnectionClosed) as caught:
            await stolen.recv()
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.reason == "this task set's certificate was revoked"
        await (await good.ping())
        await good.close()


async def test_damaged_list_keeps_the_former_one(tmp_path: Path) -> None:
    site = Site(tmp_path)
    for name in ("stolen", "good"):
        site.folder.issue(name)
    site.folder.revoke("stolen")
    async with site.server:
        assert "was revoked" in await site.refusal(site.files("stolen"))
        without_list = {name: TlsFiles(*_three(site, name)) for name in ("stolen", "good")}
        site.folder.revoked.write_text("no list")
        assert "was revoked" in await site.refusal(without_list["stolen"])
        await (await site.dial(without_list["good"])).close()


def _three(site: Site, name: str) -> tuple[Path, Path, Path]:
    return site.folder.certificate(name), site.folder.key(name), site.folder.authority


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    return lambda: [one.getMessage() for one in caplog.records if "it speaks TLS at a port" in one.message]


@pytest.mark.parametrize("loop", LOOPS)
def test_tls_client_at_a_plain_port_is_told(loop: str, tmp_path: Path, told: Callable[[], list[str]]) -> None:
    """Both ends name it: the client in its error, the server in one line for each address."""
    folder = CertificateFolder(tmp_path)
    folder.make_authority()
    context = TlsIdentity(TlsFiles(authority=folder.authority)).client()

    async def refused(port: int) -> None:
        with pytest.raises((InvalidHandshake, OSError)) as caught:
            await connect(f"wss://127.0.0.1:{port}", ssl=context, proxy=None)
        assert "the server does not speak TLS at this port; remove --tls" in str(
            explain_to_client(caught.value)
        )

    async def run() -> None:
        control = ControlServer(SECRET, on_hello=nothing, on_message=nothing, on_gone=nothing, port=0)
        async with control, HttpServer(web.Application(), "127.0.0.1", 0) as http:
            port = int(http.url.rpartition(":")[2].rstrip("/"))
            for _ in range(3):
                await refused(control.port)
                await refused(port)
            with pytest.raises(UnavailableError, match="the server does not speak TLS at this port"):
                await locate(f"https://127.0.0.1:{port}/", "testUser", tls=context)
            async with ClientSession() as session, session.get(http.url) as reply:
                assert reply.status == 404  # plain clients are served as ever

    with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
        runner.run(run())
    assert sorted(line.partition(":")[0] for line in told()) == ["HTTP", "task sets"]


async def test_robot_in_tls_at_a_plain_port_is_told(tmp_path: Path, told: Callable[[], list[str]]) -> None:
    folder = CertificateFolder(tmp_path)
    folder.make_authority()
    context = TlsIdentity(TlsFiles(authority=folder.authority)).client()
    async with running_cloud() as cloud:
        with pytest.raises(OSError) as caught:  # noqa: PT011 - what it means is looked at below
            await connect(cloud.ws_url.replace("ws://", "wss://"), ssl=context, proxy=None)
        assert "the server does not speak TLS at this port" in str(explain_to_client(caught.value))
    assert len(told()) == 1
