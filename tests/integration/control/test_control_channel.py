"""The control channel over real loopback sockets."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from support.ports import free_port
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

from rce.aio.backoff import Backoff
from rce.config.secret import Secret
from rce.control.channel import TaskSetChannel
from rce.control.exceptions import (
    MasterUnavailableError,
    PeerGoneError,
    PeerRefusedError,
    PeerTimeoutError,
    UnsendableError,
)
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Drop,
    Gone,
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
    Welcome,
    encode,
)
from rce.control.peer import Peer
from rce.control.server import ControlServer
from rce.control.timeouts import MAX_TEXT, ControlTimeouts
from rce.masters import Masters

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SECRET = Secret("the engine's secret")
QUICK = ControlTimeouts(
    open=2, close=0.2, request=5, log=0.2, backoff=Backoff(0.05, 0.05, jitter=1.0), backoff_refused=0.02
)


class Master:
    """A master that answers and remembers."""

    def __init__(self, port: int = 0, timeouts: ControlTimeouts = QUICK) -> None:
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


def headers(secret: str = SECRET.reveal()) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


async def test_hello_welcome_sync_and_messages_both_ways() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        peer, greeting = await master.hellos.get()
        assert greeting == hello()
        assert (peer.process, peer.kind) == ("robots-1", TaskSetKind.ROBOT)
        assert await robots.told.get() == Welcome(version=CONTROL_VERSION, master="master")
        assert await robots.told.get() == Sync(endpoints=())
        assert robots.channel.connected
        robots.channel.send(Left(id="u/r", reason="bye"))
        assert await master.messages.get() == Left(id="u/r", reason="bye")
        peer.send(Drop(id="u/r", revision=3))
        assert await robots.told.get() == Drop(id="u/r", revision=3)
        assert master.server.peers == (peer,)


async def test_requests_are_answered_by_number() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        replies = await asyncio.gather(
            *(robots.channel.login(f"user{n}", "r", "p") for n in range(20)),
            robots.channel.client_request("u/r", "CC", {"containerTag": "c"}),
        )
        assert [reply.reason for reply in replies if isinstance(reply, LoginReply)] == [
            f"user{n}" for n in range(20)
        ]
        assert replies[-1] == ClientReply(request=21, errors=("CC", "{'containerTag': 'c'}"))


async def test_request_waits_for_a_master_that_comes_late() -> None:
    port = free_port()
    async with TaskSet(port).running() as robots:
        login = asyncio.create_task(robots.channel.login("late", "r", "p"))
        async with Master(port).server:
            assert (await login).reason == "late"


async def test_request_ends_with_a_clear_error_when_no_master_comes() -> None:
    timeouts = ControlTimeouts(request=0.1)
    async with TaskSet(free_port(), timeouts=timeouts).running() as robots:
        with pytest.raises(MasterUnavailableError, match=r"the master did not answer within 0\.1 s"):
            await robots.channel.client_request("u/r", "DC", {"containerTag": "c"})


async def test_unanswered_request_is_sent_again_to_a_restarted_master() -> None:
    first = Master()
    first.mute = True
    async with first.server:
        port = first.server.port
        robots = TaskSet(port)
        async with robots.running():
            login = asyncio.create_task(robots.channel.login("again", "r", "p"))
            await first.messages.get()
            await first.server.__aexit__(None, None, None)
            second = Master(port)
            async with second.server:
                assert (await login).reason == "again"
                assert await second.hellos.get()
                assert second.seen["Login"] == 1
                await robots.channel.wait_connected()


async def test_send_without_a_connection_is_dropped() -> None:
    port = free_port()
    async with TaskSet(port).running() as robots:
        robots.channel.send(Left(id="u/r", reason="nobody hears this"))
        assert not robots.channel.connected
        master = Master(port)
        async with master.server:
            await robots.channel.wait_connected()
            robots.channel.send(Gone(id="u/r", revision=1))
            assert await master.messages.get() == Gone(id="u/r", revision=1)


async def test_wrong_secret_is_refused_and_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with (
        master.server,
        TaskSet(master.server.port, secret=Secret("another secret")).running() as robots,
    ):
        while caplog.text.count("refuses our secret (HTTP 401)") < 2:
            await asyncio.sleep(0.01)
        assert not robots.channel.connected
        assert master.hellos.empty()
        assert "another secret" not in caplog.text


@pytest.mark.parametrize(
    "sent",
    [
        {},
        headers("wrong secret"),
        {"Authorization": SECRET.reveal()},
        {"Authorization": f"Basic {SECRET.reveal()}"},
        {"Authorization": "Bearer \xff"},
    ],
)
async def test_handshake_without_the_secret_is_401(sent: dict[str, str]) -> None:
    async with Master().server as server:
        with pytest.raises(InvalidStatus) as caught:
            async with connect(f"ws://127.0.0.1:{server.port}", additional_headers=sent, proxy=None):
                pass
        assert caught.value.response.status_code == 401


async def test_browser_is_refused() -> None:
    async with Master().server as server:
        with pytest.raises(InvalidStatus) as caught:
            async with connect(
                f"ws://127.0.0.1:{server.port}",
                additional_headers=headers(),
                origin=Origin("http://evil.example"),
                proxy=None,
            ):
                pass
        assert caught.value.response.status_code == 403


@pytest.mark.parametrize(
    "frame", ["{", "[" * 100_000, '{"x":"Nonsense"}', '{"t":"Left","id":3}', b"\x00\xff"]
)
@pytest.mark.parametrize("greet", [False, True])
async def test_garbage_closes_the_peer_with_a_reason_and_nothing_else(
    frame: str | bytes, greet: bool
) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as bad:
            if greet:
                await bad.send(encode(hello()).replace("robots-1", "bad"))
                await bad.recv()
            await bad.send(frame)
            async with asyncio.timeout(5):
                await bad.wait_closed()
            assert bad.close_code == 1007
            assert (bad.close_reason or "").startswith("garbage: ")
        assert (await robots.channel.login("still here", "r", "p")).reason == "still here"
        assert [peer.process for peer in master.server.peers] == ["robots-1"]


async def test_a_task_set_that_stops_takes_its_leave() -> None:
    left: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()

    async def welcome(socket: ServerConnection) -> None:
        await socket.recv()
        await socket.send(encode(Welcome(version=CONTROL_VERSION, master="master")))
        await socket.wait_closed()
        left.set_result(socket.close_code)

    async with serve(welcome, "127.0.0.1", 0) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        async with TaskSet(port).running() as robots:
            await robots.channel.wait_connected()
        assert await asyncio.wait_for(left, 5) == 1000


async def test_first_message_must_be_hello() -> None:
    async with Master().server as server:
        url = f"ws://127.0.0.1:{server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as bad:
            await bad.send(encode(Left(id="u/r", reason="")))
            with pytest.raises(ConnectionClosed, match="the first message must be Hello"):
                await bad.recv()


async def test_other_version_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    async with Master().server as server:
        url = f"ws://127.0.0.1:{server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as old:
            await old.send(encode(hello()).replace(f'"version":{CONTROL_VERSION}', '"version":99'))
            refusal = str(await old.recv())
            assert '"t":"Refused"' in refusal
            assert "upgrade the older one" in refusal


async def test_older_task_set_works_beside_newer_ones() -> None:
    """A task set of the release before works beside newer ones."""
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as old:
            text = '{"t":"Hello","version":1,"kind":"container","process":"old","machine":{"name":"m"}}'
            await old.send(text)
            assert '"t":"Welcome"' in str(await old.recv())
            (_, first), (peer, second) = [await master.hellos.get() for _ in range(2)]
            assert (first.version, second.version) == (CONTROL_VERSION, 1)
            assert peer.features == frozenset()
            await old.send('{"t":"Teleport","where":"mars"}')  # of a later release: passed over
            await old.send(encode(Left(id="u/r", reason="of old")))
            while not isinstance(message := await master.messages.get(), Left):
                pass
            assert message.reason == "of old"
        await robots.channel.login("still here", "r", "p")


async def test_orders_of_a_later_master_are_passed_over() -> None:
    taken: asyncio.Queue[ToTaskSet] = asyncio.Queue()

    async def serve_one(socket: ServerConnection) -> None:
        await socket.recv()
        await socket.send(encode(Welcome(version=CONTROL_VERSION, master="m")))
        await socket.send('{"t":"Teleport","where":"mars"}')
        await socket.send(encode(Notify(id="u", text="after it")))
        await socket.wait_closed()

    async with serve(serve_one, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        channel = TaskSetChannel(f"ws://127.0.0.1:{port}", SECRET, hello, taken.put, timeouts=QUICK)
        task = asyncio.create_task(channel.run())
        try:
            while not isinstance(message := await taken.get(), Notify):
                pass
            assert message.text == "after it"
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_of_several_masters_the_next_is_dialed_when_one_is_away() -> None:
    first, second = Master(), Master()
    async with second.server, contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(first.server)
        urls = [f"ws://127.0.0.1:{master.server.port}" for master in (first, second)]
        robots = TaskSet(first.server.port)
        robots.channel = TaskSetChannel(Masters(urls), SECRET, hello, robots.handle, timeouts=QUICK)
        async with robots.running(), asyncio.timeout(30):
            await first.hellos.get()
            assert second.hellos.empty()
            await stack.aclose()
            await second.hellos.get()


async def test_refusal_is_logged_and_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    master.refuse = "no room"
    async with master.server, TaskSet(master.server.port).running() as robots:
        while "refuses this task set: no room" not in caplog.text:
            await asyncio.sleep(0.01)
        assert not robots.channel.connected
        master.refuse = ""
        await robots.channel.wait_connected()
        assert master.story == ["hello"]


async def test_same_name_again_replaces_the_older_connection() -> None:
    master = Master()
    async with master.server:
        url = f"ws://127.0.0.1:{master.server.port}"
        async with (
            connect(url, additional_headers=headers(), proxy=None) as first,
            connect(url, additional_headers=headers(), proxy=None) as second,
        ):
            await first.send(encode(hello()))
            older, _ = await master.hellos.get()
            await second.send(encode(hello()))
            newer, _ = await master.hellos.get()
            assert master.server.peers == (newer,)
            assert await master.gone.get() is older
            assert master.story == ["hello", "gone", "hello"]


async def test_failing_callback_ends_that_peer_only(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await master.hellos.get()
        await robots.channel.wait_connected()
        robots.channel.send(Left(id="u/r", reason="boom"))
        await master.gone.get()
        await master.hellos.get()  # it came back
        assert "RuntimeError: boom" in caplog.text


async def test_failing_handler_makes_the_task_set_dial_anew(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running():
        peer, _ = await master.hellos.get()
        peer.send(Notify(id="u/r", text="boom"))
        await master.hellos.get()
        assert "RuntimeError: boom" in caplog.text


async def test_read_log() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running():
        peer, _ = await master.hellos.get()
        chunk = await peer.read_log("u/c", "talker")
        assert (chunk.text, chunk.offset) == ("hello", 5)
        with pytest.raises(PeerTimeoutError, match="robots-1 did not answer"):
            await peer.read_log("u/c", "silent")


async def test_read_log_of_a_peer_that_leaves() -> None:
    master = Master(timeouts=ControlTimeouts(close=0.2, log=30))
    async with master.server:
        robots = TaskSet(master.server.port)
        async with robots.running():
            peer, _ = await master.hellos.get()
            reading = asyncio.create_task(peer.read_log("u/c", "silent"))
            while not isinstance(await robots.told.get(), ReadLog):
                pass
        with pytest.raises(PeerGoneError, match="robots-1 left"):
            await reading
        with pytest.raises(PeerGoneError):
            await peer.read_log("u/c", "talker")
        peer.send(Drop(id="u/r", revision=1))  # no effect, no error


async def test_silent_peer_is_noticed() -> None:
    quick = ControlTimeouts(ping_interval=0.05, ping_timeout=0.05, close=0.05)
    master = Master(timeouts=quick)
    async with master.server:
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None, close_timeout=0.1) as silent:
            await silent.send(encode(hello()))
            await master.hellos.get()
            silent.transport.pause_reading()
            async with asyncio.timeout(5):
                await master.gone.get()
            silent.transport.abort()


async def test_peer_that_takes_no_messages_is_cut_off(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server:
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None, close_timeout=0.1) as stuck:
            await stuck.send(encode(hello()))
            peer, _ = await master.hellos.get()
            stuck.transport.pause_reading()
            for _ in range(9000):
                peer.send(Notify(id="u/r", text="x"))
            await master.gone.get()
            assert caplog.text.count("takes no messages; cut off") == 1
            stuck.transport.abort()


async def test_large_messages_pass() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        reply = await robots.channel.client_request("u/r", "CN", "x" * (8 * 2**20))
        assert len(reply.errors[1]) == 8 * 2**20


async def test_a_request_that_cannot_be_written_fails_alone() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        for data in ("\ud800", "x" * (MAX_TEXT + 1), object()):
            with pytest.raises(UnsendableError):
                await robots.channel.client_request("u/r", "CN", data)
        robots.channel.send(Left(id="u/r", reason="\ud800"))
        reply = await robots.channel.client_request("u/r", "CC", 1)
        assert reply.errors == ("CC", "1")
        assert master.seen["ClientRequest"] == 1
        assert master.story == ["hello"]


async def test_a_long_sync_arrives() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        peer, _ = await master.hellos.get()
        text = "x" * (20 << 20)
        peer.send(Notify(id="u", text=text))
        while not isinstance(told := await robots.told.get(), Notify):
            pass
        assert told.text == text
