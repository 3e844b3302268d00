"""A node that dies is started again, and its log outlives its container and the manager of both."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest
from support.engine import Engine, running_engine, until

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError

pytestmark = [pytest.mark.e2e]

LOG = "/containers/C/nodes/echo/log"


async def node(client: ApiClient) -> dict[str, Any]:
    (found,) = (await client.call("GET", "/nodes"))["nodes"]
    return dict(found)


async def read(client: ApiClient, **query: str | int) -> dict[str, Any] | None:
    """The log; None while there is none."""
    try:
        return dict(await client.call("GET", LOG, query=query))
    except ApiError as error:
        if error.status not in (404, 503):
            raise
        return None


async def test_what_a_node_did_is_known_after_its_end() -> None:
    async with (
        running_engine(runtime="process") as engine,
        ApiClient(engine.url, engine.token()) as client,
    ):
        await client.call("POST", "/containers", {"tag": "C"})
        echo = {"tag": "echo", "pkg": "Test", "exe": "stringEcho.py", "restart": "on-failure"}
        await client.call("POST", "/containers/C/nodes", echo)

        async def runs(restarts: int) -> int:
            found = await node(client)
            is_so = found["state"] == "running" and found["restarts"] == restarts
            return int(found["pid"]) if is_so else 0

        pid = await until(lambda: runs(0), what="the node runs")
        os.kill(pid, signal.SIGKILL)
        await until(lambda: runs(1), what="the node runs again")
        chunk = await read(client, stream="engine")
        assert chunk is not None
        assert chunk["text"].startswith("-- ended: killed by SIGKILL")
        assert (chunk["ended"], bool(chunk["life"])) == (None, True)

        await client.call("DELETE", "/containers/C")
        await destroyed(engine, client)
        await engine.container.stop()
        await engine.container.start()
        again = await until(lambda: read(client, stream="engine"), what="the log of what is gone")
        assert again["text"].startswith(chunk["text"])
        assert again["text"].endswith("-- ended: it was told to by SIGINT --\n")
        assert (again["life"], again["reason"]) == (chunk["life"], "destroyed by its user")


async def destroyed(engine: Engine, client: ApiClient) -> None:
    async def is_gone() -> bool:
        chunk = await read(client)
        return chunk is not None and chunk["ended"] is not None

    await until(is_gone, what="the container has ended")
    assert engine.processes_of("stringEcho.py") == []
