"""An engine with ``rce up --tls``, seen by programs that are not of its making: curl, openssl, aiohttp."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import ssl
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

import aiohttp
import pytest
import pytest_asyncio
from support.engine import command_line, engine_processes, until
from support.ports import free_ports

from rce.ros.core import Core
from rce.tls import authority
from rce.tls.authority import CERTIFICATE_DAYS
from rce.tls.folder import CertificateFolder
from rce_client import Connection
from rce_client.exceptions import RefusedError

pytestmark = [pytest.mark.e2e, pytest.mark.needs("curl", "openssl")]

T = TypeVar("T")

BIN = Path(sys.executable).parent
START_S = 120.0
STRING = "std_msgs/String"


class World:
    """``rce up --dev --tls``, and what its files and ports are."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.http, self.control, self.robots, *self.links = free_ports(5)
        self.log = folder / "log"
        self.certificates = CertificateFolder(folder / "state" / "certificates")
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
        self.env = kept | {"XDG_RUNTIME_DIR": str(folder), "RCE_LOGIN_FILE": str(folder / "login")}
        self.process: asyncio.subprocess.Process | None = None

    @property
    def url(self) -> str:
        return f"https://127.0.0.1:{self.http}/"

    @property
    def authority(self) -> str:
        return str(self.certificates.authority)

    def trusting(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=self.authority)

    def output(self) -> str:
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    async def start(self) -> None:
        ports = {
            "http-port": self.http,
            "control-port": self.control,
            "ws-port": self.robots,
            "robot-link-port": self.links[0],
            "container-link-port": self.links[1],
        }
        options = [text for name, port in ports.items() for text in (f"--{name}", str(port))]
        state = ["--state-dir", str(self.folder / "state"), "--runtime", "process"]
        with self.log.open("ab") as log:
            self.process = await asyncio.create_subprocess_exec(
                *(str(BIN / "rce"), "up", "--dev", "--tls", *state, *options),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self.env,
                start_new_session=True,
            )

        def is_ready() -> bool:
            assert self.process is not None
            assert self.process.returncode is None, self.output()
            return "RCE ready" in self.output() and "task_set_connected container" in self.output()

        await until(is_ready, timeout=START_S, what="rce up --tls is ready")

    async def stop(self) -> None:
        assert self.process is not None
        if self.process.returncode is None:
            self.process.send_signal(signal.SIGINT)
        await self.process.wait()
        assert not engine_processes(self.folder)

    async def run(self, *argv: object, text: str = "") -> tuple[int, str]:
        """Run a program to its end.

        Returns:
            Its exit code and all that it wrote.
        """
        process = await asyncio.create_subprocess_exec(
            *map(str, argv),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=self.env,
        )
        output, _ = await process.communicate(text.encode())
        assert process.returncode is not None
        return process.returncode, output.decode()

    async def curl(self, *arguments: object) -> tuple[int, str]:
        return await self.run("curl", "-sS", "-m", "20", *arguments)

    async def says(self, *words: str) -> None:
        """Wait until one line of the engine's log holds all these words."""
        await until(
            lambda: any(all(word in line for word in words) for line in self.output().splitlines()),
            timeout=30,
            what=f"the log says {words}\n{self.output()[-3000:]}",
        )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_engine() -> AsyncIterator[World]:
    with tempfile.TemporaryDirectory(prefix="rce-", dir="/tmp") as folder:
        found = World(Path(folder))
        await found.start()
        try:
            yield found
            assert "Traceback" not in found.output()
        finally:
            await found.stop()


@pytest.fixture
def world(shared_engine: World) -> World:
    return shared_engine


in_world = pytest.mark.asyncio(loop_scope="module")


@contextlib.asynccontextmanager
async def stranger(world: World) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
    """A robot by aiohttp, which shares no code with the engine's client."""
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=world.trusting())) as session:
        query = {"userID": "testUser", "version": "20130902"}
        async with session.get(world.url, params=query) as reply:
            url = (await reply.json(content_type=None))["url"]
        assert url == f"wss://127.0.0.1:{world.robots}/"
        login = {"userID": "testUser", "robotID": "stranger"}
        login["password"] = hashlib.sha256(b"testUser").hexdigest()
        async with session.ws_connect(url, params=login) as socket:
            yield socket


def frame(type_: str, **data: object) -> str:
    return json.dumps({"type": type_, "data": data})


async def make_echo(socket: aiohttp.ClientWebSocketResponse) -> None:
    """Have a container with a node that hands the robot's messages back."""
    await socket.send_str(frame("CC", containerTag="echo"))
    kinds = [("up", "SubscriberConverter", ""), ("down", "PublisherConverter", "")]
    inside = [
        ("in", "PublisherInterface", "/stringEchoReq"),
        ("out", "SubscriberInterface", "/stringEchoResp"),
    ]
    await socket.send_str(
        frame(
            "CN",
            addNodes=[{"containerTag": "echo", "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"}],
            addInterfaces=[
                {
                    "endpointTag": end,
                    "interfaceTag": tag,
                    "interfaceType": kind,
                    "className": STRING,
                    "addr": addr,
                }
                for end, items in (("stranger", kinds), ("echo", inside))
                for tag, kind, addr in items
            ],
        )
    )
    pairs = [("stranger/up", "echo/in"), ("echo/out", "stranger/down")]
    await socket.send_str(frame("CX", connect=[{"tagA": a, "tagB": b} for a, b in pairs]))


async def await_message(socket: aiohttp.ClientWebSocketResponse, text: str) -> None:
    """Send a text again and again until it comes back."""
    async with asyncio.timeout(60):
        while True:
            await socket.send_str(frame("DM", iTag="up", type=STRING, msgID="nil", msg={"data": text}))
            with contextlib.suppress(TimeoutError):
                while True:
                    message = json.loads(await socket.receive_str(timeout=1.0))
                    if message["type"] == "DM" and message["data"]["msg"]["data"] == text:
                        return


@in_world
async def test_curl_with_the_authority_is_served(world: World) -> None:
    code, text = await world.curl(
        "--cacert", world.authority, f"{world.url}?userID=testUser&version=20130902"
    )
    assert (code, json.loads(text)) == (0, {"url": f"wss://127.0.0.1:{world.robots}/"})


@in_world
async def test_curl_without_the_authority_refuses(world: World) -> None:
    """And the engine's log has one line of it."""
    code, text = await world.curl(world.url)
    assert code == 60, text
    await world.says("HTTPS: a client at 127.0.0.1 was not taken")


@in_world
async def test_robot_by_aiohttp_gets_its_message_back(world: World) -> None:
    async with stranger(world) as socket:
        await make_echo(socket)
        await await_message(socket, "over TLS")
        await socket.send_str(frame("DC", containerTag="echo"))


class OneSegment:
    """A TLS connection that gathers all that it sends until it is told to send."""

    def __init__(self, world: World, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self.tls = world.trusting().wrap_bio(self._in, self._out, server_hostname="127.0.0.1")
        self._reader = reader
        self._writer = writer

    async def complete(self, step: Callable[[], T]) -> T:
        """Do what needs the other end's answers."""
        while True:
            try:
                return step()
            except ssl.SSLWantReadError:
                await self.send()
                self._in.write(await self._reader.read(1 << 16))

    async def send(self) -> None:
        self._writer.write(self._out.read())
        await self._writer.drain()


@in_world
async def test_a_robot_that_sends_much_and_ends_at_once_is_let_go(world: World) -> None:
    """Its end arrives together with frames that have to wait for their turn."""
    login = f"userID=testUser&robotID=hasty&password={hashlib.sha256(b'testUser').hexdigest()}"
    head = (
        f"GET /?{login} HTTP/1.1\r\nHost: 127.0.0.1:{world.robots}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    reader, writer = await asyncio.open_connection("127.0.0.1", world.robots)
    connection = OneSegment(world, reader, writer)
    await connection.complete(connection.tls.do_handshake)
    connection.tls.write(head.encode())
    assert b" 101 " in await connection.complete(lambda: connection.tls.read(4096))
    connection.tls.write(b"\x81\x82\0\0\0\0{}" * 2000)
    with contextlib.suppress(ssl.SSLWantReadError):
        connection.tls.unwrap()
    await connection.send()
    await world.says("robot_left testUser/hasty")
    writer.close()
    assert "Traceback" not in world.output()


@in_world
@pytest.mark.parametrize("port", ["http", "robots", "control"])
async def test_plain_client_is_told_to_use_tls(world: World, port: str) -> None:
    code, text = await world.curl(f"http://127.0.0.1:{getattr(world, port)}/")
    assert (code, text) == (0, "This port speaks TLS only: use https:// or wss://\n")


@in_world
async def test_our_programs_name_the_fault_of_a_wrong_authority(world: World, tmp_path: Path) -> None:
    other = CertificateFolder(tmp_path)
    other.make_authority()
    arguments = ("login", "-u", "testUser", "--password-stdin", world.url)
    code, text = await world.run(BIN / "rce", *arguments, "--authority", other.authority, text="testUser\n")
    assert code == 1
    assert "the server's certificate is not trusted" in text
    assert "--authority FILE" in text
    with pytest.raises(RefusedError, match="--authority FILE"):
        async with Connection(world.url, "testUser", "testUser", "r"):
            pass


@in_world
async def test_login_keeps_the_authority_for_other_commands(world: World) -> None:
    arguments = ("login", "-u", "testUser", "--password-stdin", world.url, "--authority", world.authority)
    code, text = await world.run(BIN / "rce", *arguments, text="testUser\n")
    assert code == 0, text
    code, text = await world.run(BIN / "rce", "user", "list")
    assert code == 0, text
    assert "testUser" in text


@in_world
@pytest.mark.parametrize("way", ["option", "key of the file"])
async def test_rce_ros_connects_with_the_authority(world: World, tmp_path: Path, way: str) -> None:
    file = tmp_path / "robot.config"
    config = {"url": world.url, "userID": "testUser", "password": "testUser", "robotID": "bridged"}
    if way != "option":
        config["authority"] = world.authority
    file.write_text(json.dumps(config))
    async with Core(port=0) as core:
        process = await asyncio.create_subprocess_exec(
            *(str(BIN / "rce-ros"), str(file), "--ros-master-uri", core.uri),
            *(["--authority", world.authority] if way == "option" else []),
            stdout=asyncio.subprocess.PIPE,
            env=world.env,
        )
        assert process.stdout is not None
        async with asyncio.timeout(60):
            assert b"rce-ros ready: robot bridged connected" in await process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        await process.communicate()


@in_world
async def test_station_serves_its_page_in_tls(world: World) -> None:
    (port,) = free_ports(1)
    async with Core(port=0) as core:
        process = await asyncio.create_subprocess_exec(
            *(str(BIN / "rce"), "ui", "--ros-master", core.uri, "--port", str(port), "--tls"),
            *("--certificates", str(world.certificates.path)),
            env=world.env,
        )
        url = f"https://127.0.0.1:{port}/"

        async def answers() -> bool:
            assert process.returncode is None
            code, text = await world.curl("--cacert", world.authority, url)
            return code == 0 and "<html" in text

        await until(answers, timeout=60, what="the station's page")
        process.send_signal(signal.SIGTERM)
        await process.wait()


@in_world
async def test_program_without_its_certificate_says_how_to_make_it(world: World) -> None:
    code, text = await world.run(
        *(BIN / "rce-robot", "127.0.0.1", "--dev", "--tls", "--certificate", "nobody"),
        *("--certificates", world.certificates.path),
    )
    assert code == 1
    assert "nobody.pem does not exist; make it (rce certificate issue NAME)" in text


@in_world
async def test_certificate_for_another_name_is_refused(world: World) -> None:
    """The engine is asked by a name that is in no certificate, as ``curl --resolve`` can."""
    where = f"elsewhere.example:{world.http}"
    code, text = await world.curl(
        *("--cacert", world.authority, "--resolve", f"{where}:127.0.0.1", f"https://{where}/")
    )
    assert code == 60, text
    assert "elsewhere.example" in text


@in_world
@pytest.mark.parametrize("certificate", ["none", "stranger's"])
async def test_task_set_without_certificate_is_refused(
    world: World, tmp_path: Path, certificate: str
) -> None:
    """Although it knows the secret: the handshake ends before it can show one."""
    secret = world.folder / "rce" / "dev-secret"
    other = CertificateFolder(tmp_path)
    other.make_authority()
    other.issue("stranger", ("127.0.0.1",))
    own = ["--cert", other.certificate("stranger"), "--key", other.key("stranger")]
    code, text = await world.curl(
        *("--cacert", world.authority, "-H", f"Authorization: Bearer {secret.read_text().strip()}"),
        *(own if certificate == "stranger's" else []),
        *("-H", "Connection: Upgrade", "-H", "Upgrade: websocket", "-H", "Sec-WebSocket-Version: 13"),
        *("-H", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", f"https://127.0.0.1:{world.control}/"),
    )
    assert code != 0
    assert "101" not in text
    await world.says("control channel: a client at 127.0.0.1 was not taken")


def foreign(world: World, own: CertificateFolder) -> None:
    """Make what was issued by an authority that has been replaced since."""
    other = CertificateFolder(own.path / "other")
    other.make_authority()
    other.issue("machine")
    for name in ("machine.pem", "machine.key"):
        (own.path / name).write_bytes((other.path / name).read_bytes())


def expired(world: World, own: CertificateFolder) -> None:
    bring(world.certificates, own, days=-1)


def revoked(world: World, own: CertificateFolder) -> None:
    bring(world.certificates, own)
    world.certificates.revoke("machine")


def bring(of: CertificateFolder, own: CertificateFolder, days: float = CERTIFICATE_DAYS) -> None:
    of.issue("machine", days=days)
    for name in ("machine.pem", "machine.key"):
        (own.path / name).write_bytes((of.path / name).read_bytes())


@in_world
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (foreign, "the server does not trust our certificate: another authority issued it"),
        (expired, "our certificate has expired; renew it where its authority is"),
        (revoked, "our certificate was revoked"),
    ],
)
async def test_refused_task_set_names_its_certificates_fault(
    world: World, tmp_path: Path, make: Callable[[World, CertificateFolder], None], words: str
) -> None:
    """At its own side, where the operator of that machine looks."""
    own = CertificateFolder(tmp_path)
    own.authority.write_bytes(world.certificates.authority.read_bytes())
    make(world, own)
    port, link = free_ports(2)
    process = await asyncio.create_subprocess_exec(
        *(str(BIN / "rce-robot"), "127.0.0.1", "--dev", "--tls", "--certificates", str(tmp_path)),
        *("--certificate", "machine", "--control-port", str(world.control), "--bind", "127.0.0.1"),
        *("--ws-port", str(port), "--link-port", str(link)),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        env=world.env,
    )
    assert process.stderr is not None
    try:
        async with asyncio.timeout(60):
            text = ""
            while "no connection to the master" not in text:
                line = await process.stderr.readline()
                assert line, text
                text += line.decode()
        assert words in text
    finally:
        process.send_signal(signal.SIGTERM)
        await process.communicate()


@in_world
async def test_curl_without_certificate_is_told_that_one_is_required(world: World) -> None:
    code, text = await world.curl("--cacert", world.authority, f"https://127.0.0.1:{world.control}/")
    assert code == 56, text
    assert "certificate required" in text


@in_world
async def test_revoked_certificate_is_listed_and_gets_nothing(world: World) -> None:
    """Also an older certificate of the name, of which a thief may have a copy; a new one is good."""
    folder = world.certificates
    at = ("--certificates", folder.path)

    async def issue() -> tuple[Path, Path]:
        code, text = await world.run(BIN / "rce", "certificate", "issue", "stolen", *at)
        assert code == 0, text
        files = folder.certificate("stolen"), folder.key("stolen")
        copies = [file.with_name(f"{file.name}.{len(kept)}") for file in files]
        for file, copy in zip(files, copies, strict=True):
            copy.write_bytes(file.read_bytes())
        kept.append((copies[0], copies[1]))
        return kept[-1]

    async def ask(pair: tuple[Path, Path]) -> tuple[int, str]:
        return await world.curl(
            *("--cacert", world.authority, "--cert", pair[0], "--key", pair[1]),
            f"https://127.0.0.1:{world.control}/",
        )

    kept: list[tuple[Path, Path]] = []
    first, second = await issue(), await issue()
    assert [(await ask(pair))[0] for pair in (first, second)] == [0, 0]
    code, text = await world.run(BIN / "rce", "certificate", "revoke", "stolen", *at)
    assert code == 0, text
    for pair in (first, second):
        code, text = await ask(pair)
        assert code == 56, text
        assert "revoked" in text
    await world.says("control channel", "its certificate was revoked")
    code, text = await world.run(BIN / "rce", "certificate", "list", *at)
    assert code == 0, text
    assert [line.split()[0] for line in text.splitlines() if " revoked " in line].count("stolen") == 2
    third = await issue()
    assert (await ask(third))[0] == 0


@in_world
async def test_task_set_with_certificate_and_wrong_secret_is_refused(world: World) -> None:
    own = world.certificates
    code, text = await world.curl(
        *("--cacert", world.authority, "--cert", own.certificate("engine"), "--key", own.key("engine")),
        *("-H", "Authorization: Bearer wrong-secret", f"https://127.0.0.1:{world.control}/"),
    )
    assert (code, text) == (0, "Task sets prove themselves by the engine's secret.\n")


@in_world
async def test_renewed_certificate_is_used_without_restart(world: World) -> None:
    """Connections that are there continue with the old one; traffic flows the whole time."""

    async def serial(port: int) -> str:
        code, text = await world.run(
            *(
                "openssl",
                "s_client",
                "-connect",
                f"127.0.0.1:{port}",
                "-CAfile",
                world.authority,
                "-showcerts",
            )
        )
        assert code == 0, text
        assert "Verify return code: 0" in text
        return text[text.index("BEGIN CERTIFICATE") : text.index("END CERTIFICATE")]

    async with stranger(world) as socket:
        await make_echo(socket)
        await await_message(socket, "before")
        before = {port: await serial(port) for port in (world.http, world.robots)}
        code, text = await world.run(
            *(BIN / "rce", "certificate", "issue", "engine", "--certificates", world.certificates.path)
        )
        assert code == 0, text
        await await_message(socket, "on the old connection")
        for port, old in before.items():
            assert await serial(port) != old
        await await_message(socket, "after")
        await socket.send_str(frame("DC", containerTag="echo"))
    async with stranger(world) as socket:
        await socket.send_str(frame("DC", containerTag="echo"))


def replaced(folder: CertificateFolder, aside: Path) -> None:
    """Issue the engine's certificate by another authority."""
    other = CertificateFolder(aside)
    other.make_authority()
    other.issue("engine", folder.details("engine").hosts)
    folder.key("engine").write_bytes(other.key("engine").read_bytes())
    folder.certificate("engine").write_bytes(other.certificate("engine").read_bytes())


@in_world
async def test_rce_ros_outlives_faults_of_the_certificate(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was connected once: it says what is wrong, keeps trying, and continues when that is repaired."""
    folder = world.certificates
    hosts = folder.details("engine").hosts
    file = tmp_path / "robot.config"
    config = {"url": world.url, "userID": "testUser", "password": "testUser", "robotID": "patient"}
    file.write_text(json.dumps({**config, "authority": world.authority}))
    command = (str(BIN / "rce-ros"), str(file), "--ros-master-uri")
    async with Core(port=0) as core:
        process = await asyncio.create_subprocess_exec(
            *(*command, core.uri),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=world.env,
        )
        stdout, stderr = process.stdout, process.stderr
        assert stdout is not None
        assert stderr is not None

        async def told(words: str) -> None:
            async with asyncio.timeout(60):
                while words not in (line := (await stderr.readline()).decode()):
                    assert line, f"rce-ros ended before it said {words!r}"

        try:
            async with asyncio.timeout(60):
                assert b"rce-ros ready: robot patient" in await stdout.readline()
            folder.issue("engine", hosts, days=-1)
            (endpoint,) = (
                found for found in engine_processes(world.folder) if "rce_robot" in command_line(found)
            )
            endpoint.kill()
            await told("the server's certificate has expired; renew it there")
            code, text = await world.run(*command, core.uri)  # one that starts now ends with the reason
            assert code == 1
            assert "the server's certificate has expired" in text
            folder.issue("engine", ["elsewhere.example.org"])
            await told("the server's certificate is for another name")
            with monkeypatch.context() as patch:
                patch.setattr(authority, "CLOCK_SKEW", timedelta(days=-1))
                folder.issue("engine", hosts)
            await told("the server's certificate is not yet valid")
            replaced(folder, tmp_path / "other")
            await told("the server's certificate is not trusted")
            folder.issue("engine", hosts)
            await told("restored: connected")
        finally:
            folder.issue("engine", hosts)
            process.send_signal(signal.SIGTERM)
            await process.communicate()


@in_world
async def test_expired_certificate_is_named(world: World) -> None:
    """The last test of this world: clients refuse, and the engine's programs say what to do."""
    hosts = world.certificates.details("engine").hosts
    world.certificates.issue("engine", hosts, days=-1)
    try:
        with pytest.raises(RefusedError, match="has expired; renew it there: rce certificate issue NAME"):
            async with Connection(world.url, "testUser", "testUser", "r", tls=world.trusting()):
                pass
    finally:
        world.certificates.issue("engine", hosts)
    async with Connection(world.url, "testUser", "testUser", "r", tls=world.trusting()) as connection:
        assert connection.connected
