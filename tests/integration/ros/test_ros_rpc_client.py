"""The connections that an XML-RPC client keeps: for the next call, not for servers that have ended."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, ClassVar

import pytest
from support.ports import free_port
from support.ros_masters import serving

from rce.dialing import connect_first
from rce.ros.errors import RpcRefusedError, RpcUnreachableError
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer, batches, client, requests
from rce.ros.xmlrpc.client_connection import ClientConnection
from rce.ros.xmlrpc.codec import encode_call


def server() -> RpcServer:
    return RpcServer(Dispatcher({"get": lambda _: (1, "", 0)}), "127.0.0.1")


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.005)


async def test_no_connection_stays_of_servers_that_ended() -> None:
    """A core calls every node that was ever started, each on a port of its own."""
    async with RpcClient() as rpc:
        for _ in range(50):
            async with server() as one:
                assert (await rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)))[0] == 1
        await until(lambda: rpc.connections == 0)


async def test_idle_connection_is_kept_for_the_next_call() -> None:
    async with RpcClient() as rpc, server() as one:
        for _ in range(10):
            await rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",))
            assert rpc.connections == 1


async def test_idle_connection_is_closed_after_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "IDLE_TIME", 0.05)
    async with RpcClient() as rpc, server() as one:
        for _ in range(3):
            await asyncio.gather(
                *(rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)) for _ in range(10))
            )
            await until(lambda: rpc.connections == 0)


async def test_burst_leaves_few_idle_connections() -> None:
    async with RpcClient() as rpc, server() as one:
        await asyncio.gather(*(rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)) for _ in range(40)))
        assert rpc.connections <= client.MAX_CONNECTIONS


async def test_time_in_which_the_client_is_stopped_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """SIGSTOP, or a machine that is suspended: the server is not late."""
    monkeypatch.setattr(requests, "STOPPED_S", 0.5)
    async with RpcClient() as rpc, server() as one:
        call = asyncio.create_task(rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",), timeout=0.3))
        await asyncio.sleep(0)
        time.sleep(1.0)
        assert (await call)[0] == 1


async def test_refused_call_is_told_from_a_lost_one() -> None:
    async with RpcClient() as rpc:
        with pytest.raises(RpcRefusedError):
            await rpc.call(f"http://127.0.0.1:{free_port()}/", "get", ("/a",))


async def test_host_of_two_addresses_that_refuse_refuses() -> None:
    port = free_port()
    with pytest.raises(ConnectionRefusedError, match="; "):
        await connect_first([(socket.AF_INET, (f"127.0.0.{host}", port)) for host in (1, 2)])


class Counted(Dispatcher):
    """Counts requests; a request may hold several calls."""

    def __init__(self) -> None:
        super().__init__(
            {
                "get": lambda caller: (1, "", caller),
                "none": lambda _: (1, "", None),
                "sum": lambda _: (1, "", 5),
            }
        )
        self.requests = 0

    def respond(self, document: bytes) -> bytes:
        self.requests += 1
        return super().respond(document)


async def test_thousand_calls_share_connections_and_requests() -> None:
    """They register the topics of a container; with a connection each, its memory was at its end."""
    dispatcher = Counted()
    async with RpcClient() as rpc, RpcServer(dispatcher, "127.0.0.1") as one:
        uri = f"http://127.0.0.1:{one.port}/"
        most = 0

        async def get(number: int) -> None:
            nonlocal most
            answer = await rpc.call(uri, "get", (f"/{number}",))
            most = max(most, rpc.connections)
            assert answer == [1, "", f"/{number}"]

        await asyncio.gather(*map(get, range(1000)))
        assert most <= client.MAX_CONNECTIONS
        assert dispatcher.requests <= 2 * client.MAX_CONNECTIONS + 1000 / batches.MAX_CALLS


async def test_call_that_cannot_be_answered_leaves_the_others_alone() -> None:
    """Among them calls of several calls, as synchronizations of masters make them."""
    several = [{"methodName": "sum", "params": ["/a"]}] * 3
    async with RpcClient() as rpc, RpcServer(Counted(), "127.0.0.1") as one:
        uri = f"http://127.0.0.1:{one.port}/"
        calls: list[tuple[str, tuple[Any, ...]]] = [("get", ("/a",)), ("none", ("/a",)), ("sum", ("/a",))]
        calls.append(("system.multicall", (several,)))
        answers = await asyncio.gather(*(rpc.call(uri, *call) for call in calls * 20))
    assert answers[::4] == [[1, "", "/a"]] * 20
    assert all(status == 0 for status, _, _ in answers[1::4])
    assert answers[2::4] == [[1, "", 5]] * 20
    assert answers[3::4] == [[[[1, "", 5]]] * 3] * 20


async def test_cancelled_call_leaves_those_beside_it_alone() -> None:
    async with RpcClient() as rpc, RpcServer(Counted(), "127.0.0.1") as one:
        uri = f"http://127.0.0.1:{one.port}/"
        calls = [asyncio.create_task(rpc.call(uri, "get", (f"/{number}",))) for number in range(200)]
        await asyncio.wait(calls, return_when=asyncio.FIRST_COMPLETED)
        for call in calls[1::2]:
            call.cancel()
        await asyncio.wait(calls)
        assert [(await call)[2] for call in calls[::2]] == [f"/{number}" for number in range(0, 200, 2)]


async def test_other_servers_get_one_call_in_a_request() -> None:
    """A server of ROS knows several calls in one request; a client must not find out by a call that fails."""

    class Foreign:
        methods: ClassVar[set[str]] = set()

        def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
            self.methods.add(method)
            return 1, "", arguments[0]

    async with serving(Foreign()) as uri, RpcClient() as rpc:
        answers = await asyncio.gather(*(rpc.call(uri, "get", (f"/{number}",)) for number in range(100)))
        assert rpc.connections <= client.MAX_CONNECTIONS
    assert [answer[2] for answer in answers] == [f"/{number}" for number in range(100)]
    assert Foreign.methods == {"get"}


async def test_calls_in_order_are_made_in_order_everywhere() -> None:
    documents = [encode_call("get", (f"/{number}",)) for number in range(20)]
    expected = [[1, "", f"/{number}"] for number in range(20)]

    class Foreign:
        def _dispatch(self, _method: str, arguments: tuple[Any, ...]) -> Any:
            seen.append(arguments[0])
            return 1, "", arguments[0]

    seen: list[str] = []
    dispatcher = Counted()
    async with (
        serving(Foreign()) as foreign,
        RpcClient() as rpc,
        RpcServer(dispatcher, "127.0.0.1") as one,
    ):
        uri = f"http://127.0.0.1:{one.port}/"
        assert not rpc.takes_batches(uri)
        assert await rpc.send_in_order(foreign, "get", documents) == expected
        assert await rpc.send_in_order(uri, "get", documents) == expected
        assert rpc.takes_batches(uri)
        assert not rpc.takes_batches(foreign)
    assert seen == [f"/{number}" for number in range(20)]
    assert dispatcher.requests == 2


async def test_closed_client_fails_what_waits() -> None:
    """Also calls that wait for their turn."""
    async with asyncio.timeout(60), silent_server() as uri:
        async with RpcClient() as rpc:
            calls = [asyncio.create_task(rpc.call(uri, "get", ("/a",), timeout=600)) for _ in range(20)]
            await until(lambda: rpc.connections == client.MAX_CONNECTIONS)
        for call in calls:
            with pytest.raises(RpcUnreachableError, match="client is closed"):
                await call
        with pytest.raises(RpcUnreachableError, match="client is closed"):
            await rpc.call(uri, "get", ("/a",))


async def test_unexpected_error_ends_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one of the event loop's transport; the call does not wait for its time to be over."""

    async def fail(*_: object) -> bytes:
        raise RuntimeError("the handler is closed")

    found: list[str] = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: found.append(str(context["exception"])))
    async with RpcClient() as rpc, server() as one, asyncio.timeout(60):
        uri = f"http://127.0.0.1:{one.port}/"
        monkeypatch.setattr(ClientConnection, "post", fail)
        with pytest.raises(RpcUnreachableError, match="the handler is closed"):
            await rpc.call(uri, "get", ("/a",), timeout=600)
        monkeypatch.undo()
        assert (await rpc.call(uri, "get", ("/a",)))[0] == 1
    assert found == ["the handler is closed"]


@asynccontextmanager
async def silent_server() -> AsyncIterator[str]:
    """A server that takes requests and answers none."""

    async def ignore(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            await reader.read()
        writer.close()

    listener = await asyncio.start_server(ignore, "127.0.0.1", 0)
    async with listener:
        yield f"http://127.0.0.1:{listener.sockets[0].getsockname()[1]}/"
