"""The control channel over real loopback sockets."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace

import pytest
from msgspec import structs
from support.absent_masters import counted_standby, unreachable_port
from support.control_ends import QUICK, SECRET, Master, TaskSet, headers, hello
from support.engine import until
from support.ports import free_port
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve

from rce.aio.backoff import Backoff
from rce.control.exceptions import (
    MasterUnavailableError,
    PeerGoneError,
    PeerTimeoutError,
)
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Drop,
    Gone,
    Left,
    LoginReply,
    ReadLog,
    Sync,
    TaskSetKind,
    Welcome,
    encode,
)
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.terms import Terms
from rce.control_channel.timeouts import ControlTimeouts
from rce.masters import Masters


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


async def test_a_connected_master_has_more_time_to_answer() -> None:
    master = Master()
    master.mute = True
    timeouts = replace(QUICK, request=0.05)
    async with master.server, TaskSet(master.server.port, timeouts=timeouts).running() as robots:
        await robots.channel.wait_connected()
        late = asyncio.create_task(robots.channel.client_request("u/r", "CC", {"containerTag": "c"}))
        peer, _ = await master.hellos.get()
        request = await master.messages.get()
        assert isinstance(request, ClientRequest)
        await asyncio.sleep(0.2)
        assert not late.done()
        peer.send(ClientReply(request=request.request, errors=("late",)))
        assert (await late).errors == ("late",)


async def test_a_connected_master_that_never_answers_is_given_up() -> None:
    master = Master()
    master.mute = True
    timeouts = replace(QUICK, request=0.1, busy=0.3)
    async with master.server, TaskSet(master.server.port, timeouts=timeouts).running() as robots:
        await robots.channel.wait_connected()
        with pytest.raises(MasterUnavailableError, match=r"within 0\.3 s"):
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


async def test_a_request_says_that_it_was_sent_before() -> None:
    """It may have been done then; one that waited for its first connection was not."""
    master = Master()
    master.mute = True
    async with master.server:
        robots = TaskSet(master.server.port)
        asking = asyncio.create_task(robots.channel.client_request("u/r", "DC", {"containerTag": "c"}))
        await asyncio.sleep(0)
        async with robots.running():
            peer, _ = await master.hellos.get()
            first = await master.messages.get()
            assert isinstance(first, ClientRequest)
            assert not first.repeated
            peer.abort()
            peer, _ = await master.hellos.get()
            assert await master.messages.get() == structs.replace(first, repeated=True)
            peer.send(ClientReply(request=first.request))
            assert (await asking).errors == ()


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


@pytest.mark.parametrize("is_there", [True, False])
async def test_masters_are_dialed_with_one_pause_for_each_round(is_there: bool) -> None:
    timeouts = replace(QUICK, backoff=Backoff(first=600.0, longest=600.0))
    master = Master()
    async with contextlib.AsyncExitStack() as stack:
        standbys = [await stack.enter_async_context(counted_standby()) for _ in range(3)]
        urls = [url for url, _ in standbys]
        if is_there:
            await stack.enter_async_context(master.server)
            urls[2] = f"ws://127.0.0.1:{master.server.port}"
        robots = TaskSet(0)
        robots.channel = TaskSetChannel(Masters(urls), SECRET, hello, robots.handle, timeouts=timeouts)
        async with robots.running(), asyncio.timeout(30):
            if is_there:
                await master.hellos.get()
            else:
                await until(lambda: standbys[2][1], what="all were dialed")
            await asyncio.sleep(0.3)
        assert [len(dialed) for _, dialed in standbys] == [1, 1, 1 - is_there]


async def test_the_master_that_worked_is_dialed_first_again() -> None:
    master = Master()
    async with counted_standby() as (standby, dialed), master.server:
        robots = TaskSet(master.server.port)
        urls = [standby, f"ws://127.0.0.1:{master.server.port}"]
        robots.channel = TaskSetChannel(Masters(urls), SECRET, hello, robots.handle, timeouts=QUICK)
        async with robots.running(), asyncio.timeout(30):
            for _ in range(3):
                peer, _ = await master.hellos.get()
                await robots.channel.wait_connected()
                assert len(dialed) == 1
                peer.abort()


async def test_a_master_that_fell_silent_is_dialed_last() -> None:
    welcomed = 0

    async def fall_silent(socket: ServerConnection) -> None:
        nonlocal welcomed
        await socket.recv()
        await socket.send(encode(Welcome(version=CONTROL_VERSION, master="first")))
        welcomed += 1
        socket.transport.pause_reading()
        await socket.wait_closed()

    timeouts = replace(QUICK, master_ping_interval=0.05, ping_timeout=0.3)
    second = Master()
    async with serve(fall_silent, "127.0.0.1", 0, close_timeout=0.1) as first, second.server:
        robots = TaskSet(second.server.port)
        urls = [f"ws://127.0.0.1:{port}" for port in (first.sockets[0].getsockname()[1], second.server.port)]
        robots.channel = TaskSetChannel(Masters(urls), SECRET, hello, robots.handle, timeouts=timeouts)
        async with robots.running(), asyncio.timeout(30):
            await second.hellos.get()
            assert welcomed == 1


async def test_a_master_whose_machine_is_off_is_passed_over_soon() -> None:
    timeouts = replace(QUICK, open=600.0, connect=0.2)
    second = Master()
    async with second.server:
        with unreachable_port() as port:
            robots = TaskSet(second.server.port)
            urls = [f"ws://127.0.0.1:{each}" for each in (port, second.server.port)]
            robots.channel = TaskSetChannel(Masters(urls), SECRET, hello, robots.handle, timeouts=timeouts)
            async with robots.running(), asyncio.timeout(30):
                await second.hellos.get()


async def test_a_master_of_an_older_term_is_not_listened_to(caplog: pytest.LogCaptureFixture) -> None:
    """It leads no more, and says things that are not so any more."""
    old, new = Master(term=4), Master(term=5)
    kept: list[int] = []
    async with old.server, contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(new.server)
        urls = [f"ws://127.0.0.1:{master.server.port}" for master in (new, old)]
        robots = TaskSet(new.server.port)
        robots.channel = TaskSetChannel(
            Masters(urls), SECRET, hello, robots.handle, timeouts=QUICK, terms=Terms(3, kept.append)
        )
        async with robots.running(), asyncio.timeout(30):
            _, first = await new.hellos.get()
            assert first.term == 3
            while not isinstance(await robots.told.get(), Sync):
                pass
            await stack.aclose()
            _, second = await old.hellos.get()
            assert second.term == 5
            while "leads no more: its term is 4, and 5 has begun" not in caplog.text:
                await asyncio.sleep(0.01)
            assert not robots.channel.connected
            assert robots.told.empty()
    assert kept == [5]


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
