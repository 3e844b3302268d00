"""Services between our nodes through our core."""

from __future__ import annotations

import asyncio
import gc
import weakref
from typing import Any
from urllib.parse import urlsplit

import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import (
    NodeClosedError,
    ServiceFaultError,
    ServiceLostError,
    ServiceNotFoundError,
    ServiceTimeoutError,
    TypeMismatchError,
)
from rce.ros.node import ServiceClient
from rce.ros.node.master import MasterClient
from rce.ros.tcpros.framing import answer_frame
from rce.ros.tcpros.header import decode_header, encode_header
from rce.ros.types import Message, SerializationError, TypeRegistry

SET_BOOL = "std_srvs/SetBool"


def switch(request: Message) -> dict[str, Any]:
    return {"success": request.data, "message": "on" if request.data else "off"}


@pytest.mark.parametrize("persistent", [True, False])
async def test_calls(make_node: MakeNode, persistent: bool) -> None:
    async with make_node("a") as a, make_node("b") as b:
        service = await a.advertise_service("switch", SET_BOOL, switch)
        client = b.service_client("switch", SET_BOOL, persistent=persistent)
        for position, text in ((True, "on"), (False, "off")):
            response = await client(data=position)
            assert (response.success, response.message) == (position, text)
        assert service.calls == 2


async def test_bursts_make_no_new_connections(make_node: MakeNode, core: Core) -> None:
    """Each connection begins with a look-up of the provider, which the core counts."""
    async with make_node("a") as a, make_node("b") as b:
        all_there = asyncio.Barrier(40)

        async def meet(request: Message) -> dict[str, Any]:
            await all_there.wait()
            return switch(request)

        service = await a.advertise_service("switch", SET_BOOL, meet)
        client = b.service_client("switch", SET_BOOL)
        looked_up: list[str] = []
        find = core.graph.service

        def counting(name: str) -> str | None:
            looked_up.append(name)
            return find(name)

        core.graph.service = counting  # type: ignore[method-assign]  # the real one answers
        for _ in range(3):
            await asyncio.gather(*(client.call({"data": True}, timeout=20) for _ in range(40)))
        assert service.calls == 120
        assert len(looked_up) <= 40


async def test_requests_and_responses_of_any_size(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:

        async def mirror(payload: bytes) -> bytes:
            return payload

        await a.advertise_service_serialized("mirror", SET_BOOL, mirror)
        client = b.service_client("mirror", SET_BOOL)
        for size in (0, 1, 65535, 131_072, 10_000_000):
            assert await client.call_serialized(bytes(size), timeout=20) == bytes(size)


async def test_calls_run_side_by_side(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        waiting = 0
        all_there = asyncio.Event()

        async def meet(request: Message) -> dict[str, Any]:
            nonlocal waiting
            waiting += 1
            if waiting == 20:
                all_there.set()
            await all_there.wait()
            return switch(request)

        await a.advertise_service("meet", SET_BOOL, meet)
        client = b.service_client("meet", SET_BOOL)
        async with asyncio.timeout(60):
            answers = await asyncio.gather(*(client(data=number % 2 == 0) for number in range(20)))
        assert [answer.success for answer in answers] == [number % 2 == 0 for number in range(20)]


async def test_each_call_has_its_own_time_limit(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:

        async def maybe(request: Message) -> dict[str, Any]:
            if request.data:
                await asyncio.Event().wait()
            return switch(request)

        await a.advertise_service("maybe", SET_BOOL, maybe)
        client = b.service_client("maybe", SET_BOOL)
        stuck = asyncio.create_task(client.call({"data": True}, timeout=0.3))
        assert (await client.call({"data": False}, timeout=10)).message == "off"
        with pytest.raises(ServiceTimeoutError):
            await stuck
        assert (await client.call({"data": False}, timeout=10)).message == "off"


@pytest.mark.parametrize("is_async", [True, False])
async def test_a_handler_that_fails_answers_with_an_error(
    make_node: MakeNode, is_async: bool, caplog: pytest.LogCaptureFixture
) -> None:
    def handle(request: Message) -> dict[str, Any]:
        if request.data:
            raise ServiceFaultError("/f", "not today")
        raise ZeroDivisionError("oops")

    async def handle_later(request: Message) -> dict[str, Any]:
        await asyncio.sleep(0)
        return handle(request)

    async with make_node("a") as a, make_node("b") as b:
        await a.advertise_service("f", SET_BOOL, handle_later if is_async else handle)
        client = b.service_client("f", SET_BOOL)
        with pytest.raises(ServiceFaultError, match="not today"):
            await client(data=True)
        assert "not today" not in caplog.text
        with pytest.raises(ServiceFaultError, match="oops"):
            await client(data=False)
        assert "ZeroDivisionError" in caplog.text


async def test_call_after_a_timeout_goes_to_the_new_provider(core: Core, make_node: MakeNode) -> None:
    """The first provider fell silent, as a machine does that lost its power, with three idle connections."""
    all_there = asyncio.Barrier(3)
    set_bool = TypeRegistry().service(SET_BOOL)
    header = encode_header({"callerid": "/old", "md5sum": set_bool.md5sum, "type": SET_BOOL})
    answer = b"".join(answer_frame(set_bool.response.serialize({"message": "old"}), ok=True))

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await reader.readexactly(int.from_bytes(await reader.readexactly(4), "little"))
            writer.write(header)
            await reader.readexactly(5)
            await all_there.wait()
            writer.write(answer)
            await reader.read()
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1")
    async with server, make_node("new") as new, make_node("client") as node, asyncio.timeout(120):
        uri = f"rosrpc://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        core.graph.register_service("/switch", uri, "/old", "http://127.0.0.1:1/")
        client = node.service_client("/switch", SET_BOOL)
        answers = await asyncio.gather(*(client(data=True) for _ in range(3)))
        assert [one.message for one in answers] == ["old"] * 3
        await new.advertise_service("/switch", SET_BOOL, switch)
        with pytest.raises(ServiceTimeoutError):
            await client.call({"data": True}, timeout=0.3)
        assert (await client.call({"data": True}, timeout=30)).message == "on"
        await client.close()


async def test_a_provider_that_dies_ends_its_calls_and_may_come_back(make_node: MakeNode) -> None:
    async with make_node("b") as b:
        client = b.service_client("s", SET_BOOL)
        with pytest.raises(ServiceNotFoundError):
            await client(data=True)
        called = asyncio.Event()

        async def hang(request: Message) -> None:
            called.set()
            await asyncio.Event().wait()

        async with make_node("a") as a:
            await a.advertise_service("s", SET_BOOL, hang)
            call = asyncio.create_task(client(data=True))
            await asyncio.wait_for(called.wait(), 10)
        with pytest.raises(ServiceLostError):
            await call
        async with make_node("a") as a:
            await a.advertise_service("s", SET_BOOL, switch)
            assert (await client(data=True)).message == "on"
        with pytest.raises(ServiceNotFoundError):
            await client(data=True)


async def test_a_dead_registration_is_reported_as_lost(core: Core, make_node: MakeNode) -> None:
    async with make_node("b") as b:
        dead = MasterClient(core.uri, "/dead", "http://127.0.0.1:1/", b._running.rpc)
        await dead.register_service("/s", "rosrpc://127.0.0.1:1")
        with pytest.raises(ServiceLostError):
            await b.service_client("s", SET_BOOL)(data=True)
        with pytest.raises(TimeoutError):
            await b.wait_for_service("s", timeout=0.3)
        core.forget_node("/dead")


async def test_types_must_agree(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        await a.advertise_service("s", SET_BOOL, switch)
        with pytest.raises(ServiceFaultError, match="md5 sum"):
            await b.service_client("s", "std_srvs/Trigger")()
        with pytest.raises(TypeMismatchError):
            await a.advertise_service("s", SET_BOOL, switch)
        with pytest.raises(SerializationError):
            await b.service_client("s", SET_BOOL)(data="x")


async def test_waits_for_a_service(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        waiting = asyncio.create_task(b.wait_for_service("s", timeout=10))
        await a.advertise_service("s", SET_BOOL, switch)
        await waiting


async def test_a_closed_service_is_gone(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        service = await a.advertise_service("s", SET_BOOL, switch)
        client = b.service_client("s", SET_BOOL)
        await client(data=True)
        kept = next(iter(client._open)).connection
        await service.close()
        await asyncio.wait_for(kept.gone.wait(), 10)
        with pytest.raises(ServiceNotFoundError):
            await client(data=True)


@pytest.mark.parametrize("wrong", [{}, {"md5sum": "0" * 32}, {"service": "/other"}])
async def test_a_header_that_comes_in_pieces_is_answered(
    core: Core, make_node: MakeNode, wrong: dict[str, str]
) -> None:
    """Its end fills the buffer, so more is read at once, while the answer closes the connection."""
    probe = {"callerid": "/raw", "service": "/switch", "md5sum": "*", "probe": "1"} | wrong
    header = encode_header(probe)
    async with make_node("server") as server:
        await server.advertise_service("/switch", "std_srvs/SetBool", lambda _: {})
        where = urlsplit(core.graph.service("/switch") or "")
        for cut in (4, 5, len(header) // 2, len(header) - 1):
            reader, writer = await asyncio.open_connection(where.hostname, where.port)
            writer.write(header[:cut])
            await asyncio.sleep(0.01)  # or the system may join the pieces
            writer.write(header[cut:])
            async with asyncio.timeout(60):
                answer = await reader.read()
            assert ("error" in decode_header(answer[4:])) is bool(wrong)
            writer.close()
            await writer.wait_closed()


async def test_request_and_fields_together_are_refused(make_node: MakeNode) -> None:
    """A ``timeout`` beside a request was taken for a field, and there was no time limit."""
    async with make_node("a") as a:
        client = a.service_client("switch", SET_BOOL)
        with pytest.raises(TypeError, match="timeout"):
            await client({"data": True}, timeout=1)


async def test_calls_that_wait_for_their_turn_end_with_the_client(make_node: MakeNode) -> None:
    """They called a provider that hangs after the close, and waited for good."""
    called = asyncio.Event()

    async def hang(_: Message) -> dict[str, Any]:
        called.set()
        await asyncio.Event().wait()
        return {}

    async with make_node("a") as a, make_node("b") as b:
        await a.advertise_service("s", SET_BOOL, hang)
        client = b.service_client("s", SET_BOOL)
        client._slots = asyncio.Semaphore(1)
        calls = [asyncio.create_task(client.call({"data": True})) for _ in range(3)]
        await asyncio.wait_for(called.wait(), 20)
        await client.close()
        results = await asyncio.wait_for(asyncio.gather(*calls, return_exceptions=True), 20)
        assert [type(result) for result in results] == [ServiceLostError, NodeClosedError, NodeClosedError]


async def test_closed_clients_are_not_kept(make_node: MakeNode) -> None:
    """A node that makes a client for each call does not grow."""
    async with make_node("a") as a, make_node("b") as b:
        service = await a.advertise_service("switch", SET_BOOL, switch)
        clients: weakref.WeakSet[ServiceClient] = weakref.WeakSet()
        for number in range(100):
            client = b.service_client("switch", SET_BOOL, persistent=number % 2 == 0)
            clients.add(client)
            await client.call({"data": True}, timeout=60)
            await client.close()
        del client
        gc.collect()
        assert service.calls == 100
        assert len(clients) == 0
