"""Answers that no ROS program gives: they end neither a discovery nor a synchronization."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

import pytest
from support.multimaster import STRING, DiscoveryNetwork, node

from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError
from rce.ros.multimaster.contacts import MAX_TEXT, ask_contact
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.errors import MalformedStateError, NothingToRelayError
from rce.ros.multimaster.heartbeat import Heartbeat, Kind, Stamp
from rce.ros.multimaster.peer_table import PeerKey
from rce.ros.multimaster.relay.kinds import learn_service, learn_topic
from rce.ros.multimaster.source import RpcSource
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

HUGE = f"<int>{'9' * 400}</int>"
"""An integer that no float holds."""

HONEST = ("5.0", "http://127.0.0.1:11311/", "robot", "/master_discovery", "http://127.0.0.1:11611/")


def text(value: str) -> str:
    return f"<string>{value}</string>"


def array(*values: str) -> str:
    """Write an XML-RPC array of values that are written already."""
    return f"<array><data>{''.join(f'<value>{value}</value>' for value in values)}</data></array>"


@asynccontextmanager
async def answering(value: str) -> AsyncIterator[str]:
    """A server whose answer to every call is ``value``; yields its URI."""
    body = f"<methodResponse><params><param><value>{value}</value></param></params></methodResponse>"

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await reader.readuntil(b"</methodCall>")
            head = f"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: {len(body)}\r\n\r\n"
            writer.write((head + body).encode())
            await writer.drain()
        except (OSError, EOFError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    async with server:
        yield "http://{}:{}/".format(*server.sockets[0].getsockname())


def key_of(uri: str) -> PeerKey:
    return PeerKey("127.0.0.1", urlsplit(uri).port or 0)


CONTACTS = {
    "huge stamp": array(HUGE, *map(text, HONEST[1:])),
    "no stamp": array("<nil/>", *map(text, HONEST[1:])),
    "nothing": "<nil/>",
    "one text": text("abcde"),
    "four": array(*map(text, HONEST[:4])),
    "a number for a name": array(text("5.0"), text("http://a:1/"), "<int>7</int>", *map(text, HONEST[3:])),
    "a long name": array(
        text("5.0"), text("http://a:1/"), text("x" * (MAX_TEXT + 1)), *map(text, HONEST[3:])
    ),
    "two lines": array(text("5.0"), text("http://a:1/"), text("a\nb"), *map(text, HONEST[3:])),
}


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
async def test_contact_of_another_form_is_refused(contact: str) -> None:
    async with answering(contact) as uri, RpcClient() as rpc:
        with pytest.raises(MalformedStateError):
            await ask_contact(rpc, key_of(uri))


async def test_honest_contact_is_taken() -> None:
    async with answering(array(*map(text, HONEST))) as uri, RpcClient() as rpc:
        assert await ask_contact(rpc, key_of(uri)) == HONEST[1:4]


async def test_discovery_outlives_a_false_peer(network: DiscoveryNetwork) -> None:
    """One datagram makes it ask a server of any machine."""
    async with (
        Core(port=0) as a,
        Core(port=0) as b,
        answering(CONTACTS["huge stamp"]) as false,
        Discovery(network.settings(a.uri, name="a")) as discovery,
    ):
        beat = Heartbeat(Kind.STATE, key_of(false).rpc_port, 1.0, Stamp(1, 0), Stamp(1, 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(beat.encode(), ("127.0.0.1", network.port))
        async with asyncio.timeout(60):
            while key_of(false) not in discovery._neighbours._peers:
                await asyncio.sleep(0.02)
            async with Discovery(network.settings(b.uri, name="b")):
                while {master.name for master in discovery.masters} != {"a", "b"}:
                    await asyncio.sleep(0.02)


@pytest.mark.parametrize(
    "entry",
    [array(text("/said"), array("<int>1</int>", text("/n"))), array("<int>1</int>", array(text("/n")))],
    ids=["node", "topic"],
)
async def test_state_with_names_that_are_no_texts_is_refused(entry: str) -> None:
    state = array("<int>1</int>", text(""), array(array(entry), array(), array()))
    types = array("<int>1</int>", text(""), array())
    pid = array("<int>1</int>", text(""), "<int>1</int>")
    async with answering(array(array(state), array(types), array(pid))) as uri, RpcClient() as rpc:
        master = MasterClient(uri, "/test", "http://127.0.0.1:1/", rpc)
        with pytest.raises(MasterUnreachableError, match="no known form"):
            await RpcSource(master).read()


@pytest.mark.parametrize(
    "port",
    ["<int>70000</int>", "<int>-1</int>", "<int>0</int>", HUGE, "<nil/>"],
    ids=["high", "negative", "zero", "huge", "none"],
)
async def test_publisher_at_a_port_that_is_none(port: str) -> None:
    answer = array("<int>1</int>", text(""), array(text("TCPROS"), text("127.0.0.1"), port))
    async with answering(answer) as uri, RpcClient() as rpc:
        with pytest.raises(NothingToRelayError):
            await learn_topic(rpc, "/test", "/said", [uri])


@pytest.mark.parametrize("uri", ["rosrpc://127.0.0.1", "rosrpc://127.0.0.1:70000", "rosrpc://:5", "x", "//["])
async def test_service_at_an_address_that_is_none(uri: str) -> None:
    with pytest.raises(NothingToRelayError):
        await learn_service("/test", "/add", uri)


async def test_relay_outlives_a_publisher_without_a_port() -> None:
    answer = array("<int>1</int>", text(""), array(text("TCPROS"), text("127.0.0.1"), "<int>70000</int>"))
    async with (
        Core(port=0) as cloud,
        Core(port=0) as robot,
        answering(answer) as false,
        RpcClient() as rpc,
        MasterSync(SyncSettings(cloud.uri, relay_listen=0, relay_addr="127.0.0.1")) as one,
    ):
        await rpc.call(robot.uri, "registerPublisher", ("/false", "/nowhere", STRING, false))
        await rpc.call(robot.uri, "registerService", ("/false", "/none", "rosrpc://127.0.0.1", false))
        dialing = SyncSettings(robot.uri, relay_to=(("127.0.0.1", one.relay_port),))
        async with MasterSync(dialing), node("base", robot.uri) as base:
            await base.advertise("said", STRING)
            await cloud.wait_until(lambda graph: "/said" in graph.topic_types, timeout=30)
            assert "/nowhere" not in cloud.graph.topic_types


async def test_namespaces_outlive_a_master_that_answers_true(
    network: DiscoveryNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    """Also to the question for the publishers of a topic."""
    async with (
        answering(array("<int>1</int>", text(""), "<boolean>1</boolean>")) as master,
        answering(array(text("5.0"), text(master), text("false"), *map(text, HONEST[3:]))) as false,
        network.machine(namespaces={"*": "Far"}) as station,
    ):
        beat = Heartbeat(Kind.STATE, key_of(false).rpc_port, 1.0, Stamp(1, 0), Stamp(1, 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(beat.encode(), ("127.0.0.1", network.port))
        async with asyncio.timeout(60):
            while "the relay of false ends" not in caplog.text:
                await asyncio.sleep(0.02)
        async with network.machine(name="robot") as robot, node("base", robot.uri) as base:
            await base.advertise("said", STRING)
            await station.until(lambda graph: "/Far/said" in graph.topic_types, timeout=60)
