"""A master that is told to end while clients follow streams."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import aiohttp
import msgspec
import pytest

from rce.config.settings import LOOPBACK
from rce.control import Execute
from rce.control.execution import FEATURE, NOT_RUN, Command, Frame, Part, decode, read_ended
from rce.control.messages import TaskSetKind
from rce.control_channel.dialing import RunDialer
from rce.masters import Masters
from rce.web import serving

from .conftest import SECRET

if TYPE_CHECKING:
    from integration.master.conftest import RunSite


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "SHUTDOWN_S", 10.0)


@pytest.mark.parametrize("path", ["/events", "/usage/live?interval=3600"])
async def test_streams_end_with_the_master(run_site: RunSite, path: str) -> None:
    async with AsyncExitStack() as stack, aiohttp.ClientSession() as session, asyncio.timeout(60):
        site = await stack.enter_async_context(run_site())
        headers = {"Authorization": f"Bearer {site.token}"}
        async with session.get(f"{site.url}api/v1{path}", headers=headers) as stream:
            await stream.content.readuntil(b"\n\n")
            await stack.aclose()
            assert await stream.content.read() == b"", "it ends as a whole, without words"


async def test_a_command_ends_with_the_master(run_site: RunSite) -> None:
    async with AsyncExitStack() as stack, aiohttp.ClientSession() as session, asyncio.timeout(60):
        site = await stack.enter_async_context(run_site())
        task_set = site.task_set(TaskSetKind.CONTAINER, "c1", features=(FEATURE,))
        machine = await stack.enter_async_context(task_set)
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        headers = {"Authorization": f"Bearer {site.token}"}
        url = f"{site.url}api/v1/containers/c/exec"
        dialer = RunDialer(Masters(f"ws://{LOOPBACK}:{site.master.control_port}"), SECRET)
        async with session.ws_connect(url, headers=headers) as user:
            await user.send_str(msgspec.json.encode(Command(argv=("top",))).decode())
            order = await machine.get(Execute)
            async with dialer.dial(order.run) as run:
                await run.send(Frame(Part.OUTPUT, b"busy").encode())
                assert decode(await user.receive_bytes()) == (Part.OUTPUT, b"busy")
                ending = asyncio.create_task(stack.aclose())
                kind, data = decode(await user.receive_bytes())
                assert kind is Part.ENDED
                assert read_ended(data).code == NOT_RUN
                assert "this master ends" in read_ended(data).reason
                assert (await user.receive()).type is aiohttp.WSMsgType.CLOSE
                await run.wait_closed()
            await ending
