"""A client that knows only the protocol page gets its string back, by topic and by service."""

from __future__ import annotations

import pytest
from support.engine import running_engine
from support.stranger import check_echo, stranger, wire_echo

pytestmark = pytest.mark.e2e


@pytest.mark.parametrize("runtime", ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))])
async def test_echo_by_topic_and_service(runtime: str) -> None:
    async with running_engine(runtime=runtime) as engine, stranger(engine.url) as client:
        await wire_echo(client)
        await check_echo(client, "grüezi")
        await check_echo(client, "x" * 100_000)
        assert client.errors == []
        await client.send("DC", {"containerTag": "cTag_01"})
        await client.wait_status(dict.fromkeys(("requestIn", "responseOut", "serviceIn"), False))


async def test_faults_are_told_and_nothing_else_is_lost() -> None:
    async with running_engine() as engine, stranger(engine.url) as client:
        await client.socket.send_str("no json")
        await client.send("XY", {})
        await client.send(
            "CN", {"addNodes": [{"containerTag": "nowhere", "nodeTag": "n", "pkg": "Test", "exe": "x"}]}
        )
        await client.wait_error("nowhere")
        await wire_echo(client)
        before = len(client.errors)
        await client.publish("unknownTag", "std_msgs/String", {"data": "a"})
        await client.wait_error("unknownTag")
        await client.publish("requestIn", "std_msgs/Int32", {"data": 1})
        await client.wait_error("std_msgs/Int32")
        await client.publish("requestIn", "std_msgs/String", {"data": 7})
        await client.wait_error("data")
        await client.send(
            "CN",
            {
                "addNodes": [
                    {"containerTag": "cTag_01", "nodeTag": "bad", "pkg": "NoSuchPackage", "exe": "x"},
                    {"containerTag": "cTag_01", "nodeTag": "bad2", "pkg": "Test", "exe": "noSuchFile"},
                ]
            },
        )
        await client.wait_error("NoSuchPackage")
        await client.wait_error("noSuchFile")
        assert len(client.errors) >= before + 5
        await check_echo(client, "still here")
