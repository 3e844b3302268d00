"""The nodes of the package ``Test``, as processes on a ROS core of ours."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from rce.ros.core import Core
from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry

EXAMPLES = Path(__file__).parents[3] / "examples"
INDEX = PackageIndex([EXAMPLES])
TIMEOUT_S = 20.0


@asynccontextmanager
async def graph_with(exe: str, *arguments: str) -> AsyncIterator[Node]:
    """Run a node of the package; yield a node on the same graph. The other one must end well on SIGINT."""
    async with Core(host="127.0.0.1", port=0) as core:
        environ = {**os.environ, "ROS_MASTER_URI": core.uri, "RCE_PACKAGE_PATH": str(EXAMPLES)}
        argv = [*INDEX.find("Test").executable(exe), *arguments]
        process = await asyncio.create_subprocess_exec(*argv, env=environ)
        try:
            async with Node("tester", argv=[], master_uri=core.uri, types=TypeRegistry(INDEX)) as node:
                yield node
            process.send_signal(signal.SIGINT)
            async with asyncio.timeout(TIMEOUT_S):
                assert await process.wait() == 0
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()


async def test_string_echo_answers_by_topic_and_service() -> None:
    async with graph_with("stringEcho.py") as node:
        await node.wait_for_service("stringEchoService", timeout=TIMEOUT_S)
        response = await node.service_client("stringEchoService", "Test/StringEcho")(data="Grüße")
        assert response.data == "Grüße"
        requests = await node.advertise("stringEchoReq", "std_msgs/String")
        await requests.wait_for_subscribers(1, timeout=TIMEOUT_S)
        first = await node.subscribe("stringEchoResp", "std_msgs/String")
        requests.publish(data="once")
        async with asyncio.timeout(TIMEOUT_S):
            assert (await anext(aiter(first))).data == "once"


async def test_the_last_echo_is_latched() -> None:
    async with graph_with("stringEcho.py") as node:
        requests = await node.advertise("stringEchoReq", "std_msgs/String")
        await requests.wait_for_subscribers(1, timeout=TIMEOUT_S)
        first = await node.subscribe("stringEchoResp", "std_msgs/String")
        requests.publish(data="kept")
        async with asyncio.timeout(TIMEOUT_S):
            assert (await anext(aiter(first))).data == "kept"
            await first.close()
            late = await node.subscribe("stringEchoResp", "std_msgs/String")
            assert (await anext(aiter(late))).data == "kept"


async def test_param_test_answers_with_its_parameters_as_they_are_now() -> None:
    async with graph_with("paramTest.py", "label") as node:
        for name, value in {"int": 42, "str": "text", "float": 3.5, "bool": True}.items():
            await node.set_param(name, value)
        await node.wait_for_service("parameterTest", timeout=TIMEOUT_S)
        ask = node.service_client("parameterTest", "Test/ParameterTest")
        assert (await ask()).msg == "label: int=42 str=text float=3.5 bool=True"
        await node.set_param("int", 43)
        assert (await ask()).msg == "label: int=43 str=text float=3.5 bool=True"
        await node.delete_param("str")
        with pytest.raises(ServiceFaultError, match="parameter /str is not set"):
            await ask()
