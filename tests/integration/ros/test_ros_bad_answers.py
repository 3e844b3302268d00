"""Nodes that answer against the protocol: they cost their own messages, and no other program."""

from __future__ import annotations

import asyncio
import xmlrpc.client
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError, ServiceLostError
from rce.ros.multimaster.contacts import ask_contact
from rce.ros.multimaster.errors import MalformedStateError
from rce.ros.multimaster.peer_table import PeerKey
from rce.ros.node import Node, service_client
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer
from rce.ros.xmlrpc.codec import decode_call

STRING = "std_msgs/String"
LOG = "rosgraph_msgs/Log"
BAD_ANSWERS: tuple[Any, ...] = (
    None,
    5,
    [],
    [1, "", None],
    [1, "", ["TCPROS", "127.0.0.1", "x"]],
    [1, "", ["TCPROS", "127.0.0.1", None]],
    [1, "", ["TCPROS", "127.0.0.1", 70_000]],
    [1, "", ["TCPROS", "127.0.0.1", -1]],
    [1, "", ["TCPROS", "127.0.0.1", float("inf")]],
    [1, "", ["TCPROS", None, 5]],
    [1, "", ["TCPROS", "a.b..c", 5]],
)
BAD_DOCUMENTS = (
    b"",
    b"<methodResponse><fault><value><int>5</int></value></fault></methodResponse>",
    *(
        xmlrpc.client.dumps((answer,), methodresponse=True, allow_none=True).encode()
        for answer in BAD_ANSWERS
    ),
)


class OneAnswer(Dispatcher):
    """Gives one document in answer to every call."""

    def __init__(self, document: bytes) -> None:
        super().__init__({})
        self._document = document
        self.asked: list[str] = []
        """The topics that were asked for."""

    def respond(self, document: bytes) -> bytes:
        method, arguments = decode_call(document)
        if method == "requestTopic":
            self.asked.append(arguments[1])
        return self._document


async def test_publisher_with_a_bad_answer_ends_no_subscriber() -> None:
    answers = [OneAnswer(document) for document in BAD_DOCUMENTS]
    async with AsyncExitStack() as stack:
        core = await stack.enter_async_context(Core(port=0, rosout=True))
        rpc = await stack.enter_async_context(RpcClient())
        listener = await stack.enter_async_context(
            Node("listener", argv=[], master_uri=core.uri, intra_process=False)
        )
        talker = await stack.enter_async_context(
            Node("talker", argv=[], master_uri=core.uri, intra_process=False)
        )
        heard = await listener.subscribe("/t", STRING)
        logged = await listener.subscribe("/rosout_agg", LOG)
        for number, answer in enumerate(answers):
            server = await stack.enter_async_context(RpcServer(answer, "127.0.0.1"))
            uri = f"http://127.0.0.1:{server.port}/"
            for topic, message_type in (("/t", STRING), ("/rosout", LOG)):
                await rpc.call(core.uri, "registerPublisher", (f"/bad{number}", topic, message_type, uri))
        async with asyncio.timeout(60):
            while any(answer.asked.count(topic) < 2 for answer in answers for topic in ("/t", "/rosout")):
                await asyncio.sleep(0.01)
            publisher = await talker.advertise("/t", STRING)
            await publisher.wait_for_subscribers()
            publisher.publish(data="works")
            assert (await anext(aiter(heard))).data == "works"
            await logged.wait_for_publishers()
            talker.log.error("works")
            assert (await anext(aiter(logged))).msg == "works"


@asynccontextmanager
async def provider(core: Core, answer: bytes) -> AsyncIterator[asyncio.Event]:
    """Provide ``/s``: each client gets ``answer``; yield an event of the first one."""
    asked = asyncio.Event()

    async def greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        asked.set()
        writer.write(answer)
        await reader.read()
        writer.close()

    server = await asyncio.start_server(greet, "127.0.0.1")
    async with server, RpcClient() as rpc:
        port = server.sockets[0].getsockname()[1]
        await rpc.call(
            core.uri, "registerService", ("/bad", "/s", f"rosrpc://127.0.0.1:{port}", "http://127.0.0.1:1/")
        )
        yield asked


async def test_provider_with_a_bad_header_is_a_lost_one(core: Core, make_node: MakeNode) -> None:
    async with provider(core, b"\x05\0\0\0\x01\0\0\0a"), make_node("a") as node, asyncio.timeout(60):
        with pytest.raises(ServiceLostError, match="no known form"):
            await node.service_client("/s", "std_srvs/Empty").call({})
        with pytest.raises(TimeoutError):
            await node.wait_for_service("/s", timeout=0.3)


async def test_another_provider_is_found_behind_a_mute_one(
    core: Core, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stopped provider held those who waited, however soon another one took its place."""
    monkeypatch.setattr(service_client, "PROBE_S", 0.3)
    async with (
        provider(core, b"") as asked,
        make_node("a") as a,
        make_node("b") as b,
        asyncio.timeout(60),
    ):
        waiting = asyncio.create_task(b.wait_for_service("/s"))
        await asked.wait()
        await a.advertise_service("/s", "std_srvs/Empty", lambda _: {})
        await waiting


@pytest.mark.parametrize("uri", ["rosrpc://[bad:5", "rosrpc://a:70000", "rosrpc://", "5"])
async def test_provider_at_no_address_is_a_lost_one(core: Core, make_node: MakeNode, uri: str) -> None:
    async with make_node("a") as node:
        core.graph.register_service("/s", uri, "/bad", "http://127.0.0.1:1/")
        with pytest.raises(ServiceLostError):
            await node.service_client("/s", "std_srvs/Empty").call({})


@pytest.mark.parametrize("value", [5, "abc", {}, [1], [[]]])
async def test_master_with_a_bad_answer_is_an_unreachable_one(value: Any) -> None:
    document = xmlrpc.client.dumps(((1, "", value),), methodresponse=True).encode()
    async with RpcServer(OneAnswer(document), "127.0.0.1") as server, RpcClient() as rpc:
        master = MasterClient(f"http://127.0.0.1:{server.port}/", "/a", "http://127.0.0.1:1/", rpc)
        with pytest.raises(MasterUnreachableError, match="no known form"):
            await master.register_subscriber("/t", STRING)
        if not isinstance(value, str):
            with pytest.raises(MasterUnreachableError, match="no known form"):
                await master.lookup_service("/s")


@pytest.mark.parametrize(
    "stamp", [b"<int>1" + b"0" * 400 + b"</int>", b"<nil/>", b"x"], ids=["large", "nil", "text"]
)
async def test_discovery_with_a_bad_contact_is_one_error(stamp: bytes) -> None:
    rest = b"<value>a</value>" * 4
    document = (
        b"<methodResponse><params><param><value><array><data><value>" + stamp + b"</value>" + rest
    ) + b"</data></array></value></param></params></methodResponse>"
    async with RpcServer(OneAnswer(document), "127.0.0.1") as server, RpcClient() as rpc:
        with pytest.raises(MalformedStateError):
            await ask_contact(rpc, PeerKey("127.0.0.1", server.port))
