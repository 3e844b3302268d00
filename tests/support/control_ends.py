"""Both ends of a control channel, for tests to play on."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING

from websockets.asyncio.client import connect

from rce.aio.backoff import Backoff
from rce.config.secret import Secret
from rce.control import encode
from rce.control.exceptions import PeerRefusedError
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Hello,
    Left,
    LogChunk,
    Login,
    LoginReply,
    MachineInfo,
    Notify,
    ReadLog,
    Sync,
    TaskSetKind,
    ToMaster,
    ToTaskSet,
)
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.peer import Peer
from rce.control_channel.server import ControlServer
from rce.control_channel.timeouts import ControlTimeouts

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SECRET = Secret("the engine's secret")


QUICK = ControlTimeouts(
    open=2, close=0.2, request=5, log=0.2, backoff=Backoff(0.05, 0.05, jitter=1.0), backoff_refused=0.02
)


class Master:
    """A master that answers and remembers."""

    def __init__(self, port: int = 0, timeouts: ControlTimeouts = QUICK, *, term: int = 0) -> None:
        self.hellos: asyncio.Queue[tuple[Peer, Hello]] = asyncio.Queue()
        self.messages: asyncio.Queue[ToMaster] = asyncio.Queue()
        self.gone: asyncio.Queue[Peer] = asyncio.Queue()
        self.story: list[str] = []
        self.seen: Counter[str] = Counter()
        self.mute = False
        self.refuse = ""
        self.server = ControlServer(
            SECRET,
            on_hello=self.on_hello,
            on_message=self.on_message,
            on_gone=self.on_gone,
            port=port,
            timeouts=timeouts,
            term=term,
        )

    async def on_hello(self, peer: Peer, hello: Hello) -> None:
        if self.refuse:
            raise PeerRefusedError(self.refuse)
        self.story.append("hello")
        peer.send(Sync(endpoints=()))
        self.hellos.put_nowait((peer, hello))

    async def on_message(self, peer: Peer, message: ToMaster) -> None:
        self.seen[type(message).__name__] += 1
        if isinstance(message, Left) and message.reason == "boom":
            raise RuntimeError("boom")
        if isinstance(message, Login) and not self.mute:
            peer.send(LoginReply(request=message.request, status=401, reason=message.user))
        elif isinstance(message, ClientRequest) and not self.mute:
            peer.send(ClientReply(request=message.request, errors=(message.type, str(message.data))))
        self.messages.put_nowait(message)

    async def on_gone(self, peer: Peer) -> None:
        self.story.append("gone")
        self.gone.put_nowait(peer)


class TaskSet:
    """A task set that remembers what it was told."""

    def __init__(self, port: int, *, secret: Secret = SECRET, timeouts: ControlTimeouts = QUICK) -> None:
        self.told: asyncio.Queue[ToTaskSet] = asyncio.Queue()
        self.channel = TaskSetChannel(f"ws://127.0.0.1:{port}", secret, hello, self.handle, timeouts=timeouts)

    async def handle(self, message: ToTaskSet) -> None:
        if isinstance(message, ReadLog) and message.node == "talker":
            self.channel.send(LogChunk(request=message.request, offset=5, text="hello"))
        if isinstance(message, Notify) and message.text == "boom":
            raise RuntimeError("boom")
        self.told.put_nowait(message)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[TaskSet]:
        task = asyncio.create_task(self.channel.run())
        try:
            yield self
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def hello() -> Hello:
    return Hello(
        version=CONTROL_VERSION,
        kind=TaskSetKind.ROBOT,
        process="robots-1",
        machine=MachineInfo(name="m"),
    )


@contextlib.asynccontextmanager
async def deaf_task_set(master: Master) -> AsyncIterator[Peer]:
    """A task set that says hello and then reads nothing; yields the master's end of it."""
    url = f"ws://127.0.0.1:{master.server.port}"
    async with connect(url, additional_headers=headers(), proxy=None, close_timeout=0.1) as socket:
        await socket.send(encode(hello()))
        peer, _ = await master.hellos.get()
        socket.transport.pause_reading()
        try:
            yield peer
        finally:
            socket.transport.abort()


def headers(secret: str = SECRET.reveal()) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}
