"""ROS masters and nodes refuse what pages in browsers send to them."""

from __future__ import annotations

import aiohttp
import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.xmlrpc.codec import encode_call

SIMPLE = {"Content-Type": "text/plain"}
"""With this one, browsers ask the server for no permission first."""


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:11311"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
async def test_web_page_cannot_call_master_or_node(
    core: Core, make_node: MakeNode, headers: dict[str, str]
) -> None:
    call = encode_call("setParam", ("/page", "/speed", 5))
    async with make_node("a") as node, aiohttp.ClientSession() as browser:
        for uri in (core.uri, node.uri):
            async with browser.post(uri, data=call, headers=SIMPLE | headers) as reply:
                assert reply.status == 403
                assert "web pages" in await reply.text()
        assert not await node.has_param("/speed")
        async with browser.post(core.uri, data=call, headers=SIMPLE) as reply:
            assert reply.status == 200
        assert await node.get_param("/speed") == 5
