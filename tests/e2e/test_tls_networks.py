"""Two machines with an engine between them: what crosses the network is in TLS, on every port.

The machines are network namespaces; a packet socket on the second one sees all that passes between them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.engine import until
from support.networks import NetworkMachine, network
from support.short_folders import PREFIX, TMP

from rce.tls.folder import CertificateFolder

pytestmark = [pytest.mark.e2e, pytest.mark.needs("root", "netns", "bwrap"), pytest.mark.timeout(240)]

BIN = Path(sys.executable).parent
SECRET = "a secret of the two machines"
MARK = "payload-of-the-robot-"
CAPTURE = """
import socket, sys
wire = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
print("capture ready:", flush=True)
with open(sys.argv[1], "wb", buffering=0) as file:
    while True:
        file.write(wire.recv(1 << 17))
"""
ROBOT = """
import asyncio, ssl, sys
from rce_client import Connection

ADDRESS = "/stringEchoService"

async def main(url, authority, count):
    tls = ssl.create_default_context(cafile=authority) if authority else None
    async with Connection(url, "testUser", "testUser", "r", tls=tls, on_error=print) as robot:
        await robot.create_container("c")
        await robot.add_node("c", "echo", "Test", "stringEcho.py")
        await robot.add_interface("c", "srv", "ServiceClientInterface", "Test/StringEcho", addr=ADDRESS)
        echo = await robot.service_client("ask", "Test/StringEcho")
        await robot.connect("r/ask", "c/srv")
        await robot.wait_active("ask", 60)
        while True:
            try:
                await echo({"data": "warm"}, timeout=10)
                break
            except Exception as error:
                print("not yet:", error, flush=True)
                await asyncio.sleep(0.2)
        for number in range(int(count)):
            text = f"MARK{number}" * 20
            assert (await echo({"data": text}, timeout=30))["data"] == text
        print("all came back", flush=True)
        await robot.remove_all()

asyncio.run(main(*sys.argv[1:]))
""".replace("MARK", MARK)


class Machines:
    """A cloud machine with master and robot endpoint, and another one with containers."""

    def __init__(self, folder: Path, places: list[NetworkMachine], *, tls: bool) -> None:
        self.folder = folder
        self.cloud, self.other = places
        self.certificates = CertificateFolder(folder / "certificates")
        self.tls = tls
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
        self.env = kept | {"RCE_SECRET": SECRET, "PYTHONUNBUFFERED": "1"}
        self.processes: list[asyncio.subprocess.Process] = []

    def output(self, name: str) -> str:
        file = self.folder / f"{name}.log"
        return file.read_text(errors="replace") if file.exists() else ""

    async def start(self, place: NetworkMachine, name: str, *argv: object, ready: str = " ready:") -> None:
        run_dir = self.folder / f"{place.address}"
        run_dir.mkdir(exist_ok=True, mode=0o700)
        with (self.folder / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *(*place.prefix, *map(str, argv)),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self.env | {"XDG_RUNTIME_DIR": str(run_dir)},
                start_new_session=True,
            )
        self.processes.append(process)
        await until(
            lambda: ready in self.output(name) or process.returncode is not None,
            timeout=60,
            what=f"{name}: {self.output(name)}",
        )
        assert ready in self.output(name), self.output(name)

    async def start_engine(self) -> None:
        tls = ("--tls", "--certificates", self.certificates.path) if self.tls else ()
        await self.start(self.other, "capture", sys.executable, "-c", CAPTURE, self.folder / "packets")
        state = self.folder / "state"
        settings = ("--settings", '{"dev": true}', "--bind", self.cloud.address)
        await self.start(
            self.cloud,
            "master",
            *(BIN / "rce-master", *settings, "--state-dir", state / "master", *tls, "--certificate", "cloud"),
        )
        await self.start(
            self.cloud,
            "robot",
            *(BIN / "rce-robot", self.cloud.address, "--bind", self.cloud.address, "--machine", "cloud"),
            *(*tls, "--certificate", "cloud"),
        )
        await self.start(
            self.other,
            "container",
            *(BIN / "rce-container", self.cloud.address, "--bind", self.other.address, "--machine", "other"),
            *("--runtime", "namespace", "--state-dir", state / "container", *tls, "--certificate", "other"),
        )

    async def drive(self, count: int) -> None:
        """Have a robot on the containers' machine call a node ``count`` times, all through the cloud."""
        script = self.folder / "robot.py"
        script.write_text(ROBOT)
        url = f"{'https' if self.tls else 'http'}://{self.cloud.address}:9000/"
        authority = self.certificates.authority if self.tls else ""
        await self.start(
            self.other,
            "client",
            *(sys.executable, script, url, authority, count),
            ready="all came back",
        )

    async def stop(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
            await process.wait()


@contextlib.asynccontextmanager
async def machines(*, tls: bool) -> AsyncIterator[Machines]:
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=TMP) as path, network(2) as places:
        folder = Path(path)
        world = Machines(folder, places, tls=tls)
        if tls:
            world.certificates.make_authority()
            for name, place in zip(("cloud", "other"), places, strict=True):
                world.certificates.issue(name, (place.address,))
        try:
            await world.start_engine()
            yield world
        except BaseException:
            for name in ("master", "robot", "container", "client"):
                print(f"----- {name}\n{world.output(name)[-4000:]}")  # noqa: T201
            raise
        finally:
            await world.stop()


@pytest.mark.parametrize("tls", [True, False], ids=["tls", "plain"])
async def test_payloads_and_secrets_cross_networks_in_tls_only(tls: bool) -> None:
    """The plain engine is the counter-check: the same look finds the payload and the secret there."""
    digest = "ae5deb822e0d71992900471a7199d0d95b8e7c9d05c40a8245a281fd2c1d6684"  # of testUser
    async with machines(tls=tls) as world:
        await world.drive(20)
        packets = (world.folder / "packets").read_bytes()
        found = {text: text.encode() in packets for text in (MARK, SECRET, digest, "stringEcho")}
        assert len(packets) > 20_000
        assert (MARK.encode() in packets, SECRET.encode() in packets) == (not tls, not tls), found
        assert any(found.values()) == (not tls), found
        for name in ("master", "robot", "container"):
            assert "Traceback" not in world.output(name)
            assert ("without TLS" in world.output(name)) == (not tls), name


async def test_machine_without_tls_gets_no_task_set_in() -> None:
    async with machines(tls=True) as world:
        await world.start(
            world.other,
            "stranger",
            *(BIN / "rce-robot", world.cloud.address, "--bind", world.other.address),
            ready="This port speaks TLS only",
        )
        await until(
            lambda: "control channel: a client at 10.77.0.2 was not taken" in world.output("master"),
            what="the master's log has a line of it",
        )
        assert "Traceback" not in world.output("master")
