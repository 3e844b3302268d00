"""Connection headers, right and wrong ones: our nodes answer them as rospy's and roscpp's do."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import pytest
from support.ros_nodes import MakeGraphNode
from support.ros_real import Graph

from rce.ros.tcpros.header import decode_header, encode_header
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient

pytestmark = [pytest.mark.needs("rospy")]

TYPES = TypeRegistry()
STRING, SET_BOOL = TYPES.message("std_msgs/String"), TYPES.service("std_srvs/SetBool")
RIGHT = {
    "callerid": "/asking",
    "topic": "/peer_out",
    "type": STRING.name,
    "md5sum": STRING.md5sum,
    "message_definition": STRING.definition,
}
ASKING = {"callerid": "/asking", "service": "/peer_set", "md5sum": SET_BOOL.md5sum, "type": SET_BOOL.name}
OTHER_MD5 = "0" * 32


def without(fields: Mapping[str, str], *names: str) -> dict[str, str]:
    return {name: value for name, value in fields.items() if name not in names}


TOPIC_HEADERS = {
    "right": RIGHT,
    "quickly": RIGHT | {"tcp_nodelay": "1"},
    "slowly": RIGHT | {"tcp_nodelay": "0"},
    "any type": RIGHT | {"type": "*", "md5sum": "*"},
    "any checksum": RIGHT | {"md5sum": "*"},
    "no definition": without(RIGHT, "message_definition"),
    "unknown field": RIGHT | {"weather": "fine"},
    "another checksum": RIGHT | {"md5sum": OTHER_MD5},
    "another topic": RIGHT | {"topic": "/nothing"},
    "no checksum": without(RIGHT, "md5sum"),
    "no type": without(RIGHT, "type"),
    "neither topic nor service": without(RIGHT, "topic"),
}
SERVICE_HEADERS: dict[str, dict[str, str]] = {
    "right": ASKING,
    "kept": ASKING | {"persistent": "1"},
    "any checksum": ASKING | {"md5sum": "*"},
    "no type": without(ASKING, "type"),
    "probe": {"callerid": "/asking", "service": "/peer_set", "md5sum": "*", "probe": "1"},
    "another checksum": ASKING | {"md5sum": OTHER_MD5},
    "another service": ASKING | {"service": "/nothing"},
    "no checksum": without(ASKING, "md5sum"),
}


async def answer(host: str, port: int, fields: Mapping[str, str]) -> dict[str, str] | str:
    """Send a header; return the fields that come back, or that nothing does (roscpp may just be silent)."""
    reader, writer = await asyncio.open_connection(host, port)
    try:
        writer.write(encode_header(fields))
        async with asyncio.timeout(3):
            (length,) = struct.unpack("<I", await reader.readexactly(4))
            found = decode_header(await reader.readexactly(length))
    except (asyncio.IncompleteReadError, ConnectionError, TimeoutError):
        return "refused"
    finally:
        writer.close()
        await writer.wait_closed()
    if "error" in found:
        return "refused"
    return without(found, "callerid")


async def topic_answers(uri: str) -> dict[str, Any]:
    async with RpcClient() as rpc:
        _, _, (_, host, port) = await rpc.call(uri, "requestTopic", ("/asking", "/peer_out", [["TCPROS"]]))
    return {case: await answer(host, port, fields) for case, fields in TOPIC_HEADERS.items()}


async def service_answers(graph: Graph) -> dict[str, Any]:
    where = urlsplit(str(await graph.service("/peer_set")))
    assert where.hostname
    assert where.port
    host, port = where.hostname, where.port
    return {case: await answer(host, port, fields) for case, fields in SERVICE_HEADERS.items()}


@pytest.mark.parametrize("language", ["rospy", pytest.param("roscpp", marks=pytest.mark.needs("roscpp"))])
async def test_headers_are_answered_as_real_nodes_do(
    ours: Graph, make_node: MakeGraphNode, language: str, request: pytest.FixtureRequest
) -> None:
    peer = request.getfixturevalue(f"{language}_peer")
    async with ours.program(*peer):
        await ours.until(lambda: ours.service("/peer_ask"), what="the peer is up")
        uri = await ours.node(f"/{language}_peer")
        assert uri is not None
        expected = {"topic": await topic_answers(uri), "service": await service_answers(ours)}
    async with make_node(ours, "mine") as node:
        await node.advertise("/peer_out", STRING)
        await node.advertise_service("/peer_set", SET_BOOL, lambda _: {})
        found = {"topic": await topic_answers(node.uri), "service": await service_answers(ours)}
    assert found["topic"] == expected["topic"]
    for case, theirs in expected["service"].items():
        mine = found["service"][case]
        if "refused" in (mine, theirs):
            assert mine == theirs, case
        else:  # ours says what roscpp's says and what rospy's says
            assert theirs.items() <= mine.items(), case
