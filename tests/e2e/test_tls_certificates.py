"""Certificates of an engine with ``rce up --tls``: missing, wrong, expired, revoked, renewed."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from support.engine import command_line, engine_processes
from support.ports import free_ports
from support.tls_engine import BIN, World, await_message, frame, in_world, make_echo, stranger

from rce.ros.core import Core
from rce.tls import authority
from rce.tls.authority import CERTIFICATE_DAYS
from rce.tls.folder import CertificateFolder
from rce_client import Connection
from rce_client.exceptions import RefusedError

NAMED = "named.example"

pytestmark = [pytest.mark.e2e, pytest.mark.needs("curl", "openssl")]


@in_world
async def test_program_without_its_certificate_says_how_to_make_it(world: World) -> None:
    code, text = await world.run(
        *(BIN / "rce-robot", "127.0.0.1", "--dev", "--tls", "--certificate", "nobody"),
        *("--certificates", world.certificates.path),
    )
    assert code == 1
    assert "nobody.pem does not exist; make it (rce certificate issue NAME " in text


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
async def test_name_in_the_certificate_is_served(world: World) -> None:
    where = f"{NAMED}:{world.http}"
    folder = world.certificates
    folder.issue("engine", ("127.0.0.1", NAMED))
    code, text = await world.curl(
        *(
            "--cacert",
            world.authority,
            "--resolve",
            f"{where}:127.0.0.1",
            f"https://{where}/api/v1/openapi.json",
        )
    )
    assert (code, "openapi" in text) == (0, True), text


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
    async with Core(port=0) as core, Core(port=0) as other_core:
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
            # One that starts now ends with the reason; at the same core it would displace the first.
            code, text = await world.run(*command, other_core.uri)
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
