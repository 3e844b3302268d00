"""A master that has lost the lead, and has not ended yet, as after its process stood still."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from rce.config.settings import LOOPBACK
from rce.control import decode_to_task_set, encode
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Hello,
    MachineInfo,
    TaskSetKind,
)
from rce_master import master
from rce_master.exceptions import FencedError
from rce_master.http import api_exec, api_stream
from rce_master.leadership import Fence
from rce_master.leadership.core import LeadershipCore, LeaseSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.master.conftest import RunSite


class Lead:
    """The lead of a master, by a clock of the test."""

    def __init__(self) -> None:
        self.now = 100.0
        core = LeadershipCore(LeaseSettings(ttl=3.0))
        core.granted(self.now, 3.0)
        core.elected(0, self.now)
        self.fence = Fence(core, lambda: self.now, "one:9000")

    def end(self) -> None:
        self.now += 3.0


@pytest.fixture
def lead(monkeypatch: pytest.MonkeyPatch) -> Lead:
    monkeypatch.setattr(master, "TICK_S", 3600.0)  # nothing tells the master that it has lost the lead
    monkeypatch.setattr(api_stream, "HEARTBEAT_S", 0.05)
    return Lead()


@pytest.mark.parametrize("path", ["/events", "/usage/live?interval=1"])
async def test_streams_end_with_the_lead(run_site: RunSite, lead: Lead, path: str) -> None:
    async with run_site(fence=lead.fence) as site, asyncio.timeout(60):
        headers = {"Authorization": f"Bearer {site.token}"}
        async with site.session.get(f"{site.url}api/v1{path}", headers=headers) as stream:
            assert stream.status == 200
            await stream.content.readline()
            lead.end()
            await stream.read()


async def test_health_tells_the_role_when_the_lead_is_lost(run_site: RunSite, lead: Lead) -> None:
    async with run_site(fence=lead.fence) as site:
        async with site.session.get(f"{site.url}healthz") as reply:
            assert reply.status == 200
            before = await reply.json()
        lead.end()
        async with site.session.get(f"{site.url}healthz") as reply:
            assert reply.status == 503
            after = await reply.json()
        assert (before["role"], before["leader"], before["ready"]) == ("leader", "one:9000", True)
        assert (after["role"], after["leader"], after["ready"]) == ("standby", "", False)
        assert before.keys() - after.keys() == {"task_sets"}
        assert after["live"] is True
        await site.api("GET", "/robots", status=503)


class Told:
    """A user's WebSocket that notes what it is sent."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    async def send_bytes(self, frame: bytes) -> None:
        self.frames.append(frame)


class LeadingCall:
    """The used part of a call."""

    request = None

    def __init__(self, lead: Lead) -> None:
        self.check_lead = lead.fence.check


async def test_output_of_commands_ends_with_the_lead(lead: Lead) -> None:
    user = Told()

    async def output() -> AsyncIterator[bytes]:
        yield b"1"
        lead.end()
        yield b"2"

    with pytest.raises(FencedError):
        await api_exec._to_user(cast("Any", LeadingCall(lead)), cast("Any", output()), cast("Any", user))
    assert user.frames == [b"1"]


async def test_task_sets_hear_nothing_after_the_lead_is_lost(run_site: RunSite, lead: Lead) -> None:
    machine = MachineInfo(name="machine", cores=2)
    hello = Hello(version=CONTROL_VERSION, kind=TaskSetKind.CONTAINER, process="c1", machine=machine)
    question = ClientRequest(request=1, id="anna/rob", type="CC", data=None)
    async with run_site(fence=lead.fence) as site, asyncio.timeout(60):
        headers = {"Authorization": "Bearer a secret for the tests"}
        url = f"ws://{LOOPBACK}:{site.master.control_port}/"
        async with connect(url, additional_headers=headers) as task_set:
            await task_set.send(encode(hello))
            await task_set.send(encode(question))
            while not isinstance(decode_to_task_set(await task_set.recv()), ClientReply):
                continue
            lead.end()
            await task_set.send(encode(question))
            with pytest.raises(ConnectionClosed):
                await task_set.recv()


async def test_a_task_set_of_a_newer_term_dials_the_next_master(run_site: RunSite, lead: Lead) -> None:
    """It is not refused: it would wait before it dials the master that leads now."""
    machine = MachineInfo(name="machine", cores=2)
    hello = Hello(version=CONTROL_VERSION, kind=TaskSetKind.CONTAINER, process="c1", machine=machine, term=1)
    async with run_site(fence=lead.fence) as site, asyncio.timeout(60):
        headers = {"Authorization": "Bearer a secret for the tests"}
        url = f"ws://{LOOPBACK}:{site.master.control_port}/"
        async with connect(url, additional_headers=headers) as task_set:
            await task_set.send(encode(hello))
            with pytest.raises(ConnectionClosed) as closed:
                await task_set.recv()
        assert lead.fence.is_closed
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == CloseCode.GOING_AWAY
