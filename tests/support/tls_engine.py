"""An engine with ``rce up --tls``, and programs that are not of its making."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import ssl
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TypeVar

import aiohttp
import pytest

from rce.tls.folder import CertificateFolder
from support.engine import engine_processes, until
from support.ports import free_ports
from support.processes import run_to_end

T = TypeVar("T")


BIN = Path(sys.executable).parent


START_S = 120.0


STRING = "std_msgs/String"


PUBLIC = "public"
"""Name of the certificate of the other authority."""


in_world = pytest.mark.asyncio(loop_scope="module")


class World:
    """``rce up --dev --tls``, and what its files and ports are.

    Args:
        folder: Of its files.
        public: Clients get the certificate of another authority, which stands for a public one.
    """

    def __init__(self, folder: Path, *, public: bool = False) -> None:
        self.folder = folder
        self.http, self.control, self.robots, *self.links = free_ports(5)
        self.log = folder / "log"
        self.certificates = CertificateFolder(folder / "state" / "certificates")
        self.for_clients = CertificateFolder(folder / "public") if public else self.certificates
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
        self.env = kept | {"XDG_RUNTIME_DIR": str(folder), "RCE_LOGIN_FILE": str(folder / "login")}
        self.process: asyncio.subprocess.Process | None = None

    @property
    def url(self) -> str:
        return f"https://127.0.0.1:{self.http}/"

    @property
    def authority(self) -> str:
        """The authority that clients trust."""
        return str(self.for_clients.authority)

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
        if self.for_clients is not self.certificates:
            self.for_clients.make_authority()
            self.for_clients.issue(PUBLIC, ("127.0.0.1",))
            files = {"cert": self.for_clients.certificate(PUBLIC), "key": self.for_clients.key(PUBLIC)}
            options += [text for name, file in files.items() for text in (f"--tls-{name}", str(file))]
        state = ["--state-dir", str(self.folder / "state"), "--runtime", "process", "--no-offer-images"]
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
        """Run a program to its end; return its exit code and all that it wrote."""
        return await run_to_end(*argv, env=self.env, text=text)

    async def curl(self, *arguments: object) -> tuple[int, str]:
        return await self.run("curl", "-sS", "-m", "20", *arguments)

    async def says(self, *words: str) -> None:
        """Wait until one line of the engine's log holds all these words."""
        await until(
            lambda: any(all(word in line for word in words) for line in self.output().splitlines()),
            timeout=30,
            what=f"the log says {words}\n{self.output()[-3000:]}",
        )


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
