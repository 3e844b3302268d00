"""What the control channel refuses: peers without the secret, browsers, other versions, garbage."""

from __future__ import annotations

import asyncio

import pytest
from support.control_ends import QUICK, SECRET, Master, TaskSet, headers, hello
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import CloseCode
from websockets.typing import Origin

from rce.config.secret import Secret
from rce.control import ContentError
from rce.control.messages import (
    CONTROL_VERSION,
    Left,
    Notify,
    ToTaskSet,
    Welcome,
    encode,
)
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.contents import ContentClient
from rce.control_channel.server import ControlServer
from rce.masters import Masters


async def test_wrong_secret_is_refused_and_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with (
        master.server,
        TaskSet(master.server.port, secret=Secret("another secret")).running() as robots,
    ):
        while caplog.text.count("refuses our secret (HTTP 401)") < 2:
            await asyncio.sleep(0.01)
        assert not robots.channel.connected
        assert master.hellos.empty()
        assert "another secret" not in caplog.text


@pytest.mark.parametrize(
    "sent",
    [
        {},
        headers("wrong secret"),
        {"Authorization": SECRET.reveal()},
        {"Authorization": f"Basic {SECRET.reveal()}"},
        {"Authorization": "Bearer \xff"},
    ],
)
async def test_handshake_without_the_secret_is_401(sent: dict[str, str]) -> None:
    async with Master().server as server:
        with pytest.raises(InvalidStatus) as caught:
            async with connect(f"ws://127.0.0.1:{server.port}", additional_headers=sent, proxy=None):
                pass
        assert caught.value.response.status_code == 401


async def test_browser_is_refused() -> None:
    async with Master().server as server:
        with pytest.raises(InvalidStatus) as caught:
            async with connect(
                f"ws://127.0.0.1:{server.port}",
                additional_headers=headers(),
                origin=Origin("http://evil.example"),
                proxy=None,
            ):
                pass
        assert caught.value.response.status_code == 403


@pytest.mark.parametrize(
    "frame", ["{", "[" * 100_000, '{"x":"Nonsense"}', '{"t":"Left","id":3}', b"\x00\xff"]
)
@pytest.mark.parametrize("greet", [False, True])
async def test_garbage_closes_the_peer_with_a_reason_and_nothing_else(
    frame: str | bytes, greet: bool
) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as bad:
            if greet:
                await bad.send(encode(hello()).replace("robots-1", "bad"))
                await bad.recv()
            await bad.send(frame)
            async with asyncio.timeout(60):
                await bad.wait_closed()
            assert bad.close_code == 1007
            assert (bad.close_reason or "").startswith("garbage: ")
        assert (await robots.channel.login("still here", "r", "p")).reason == "still here"
        assert [peer.process for peer in master.server.peers] == ["robots-1"]


async def test_first_message_must_be_hello() -> None:
    async with Master().server as server:
        url = f"ws://127.0.0.1:{server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as bad:
            await bad.send(encode(Left(id="u/r", reason="")))
            with pytest.raises(ConnectionClosed, match="the first message must be Hello"):
                await bad.recv()


async def test_other_version_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    async with Master().server as server:
        url = f"ws://127.0.0.1:{server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as old:
            await old.send(encode(hello()).replace(f'"version":{CONTROL_VERSION}', '"version":99'))
            refusal = str(await old.recv())
            assert '"t":"Refused"' in refusal
            assert "upgrade the older one" in refusal


async def test_older_task_set_works_beside_newer_ones() -> None:
    """A task set of the release before works beside newer ones."""
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as old:
            text = '{"t":"Hello","version":1,"kind":"container","process":"old","machine":{"name":"m"}}'
            await old.send(text)
            assert '"t":"Welcome"' in str(await old.recv())
            (_, first), (peer, second) = [await master.hellos.get() for _ in range(2)]
            assert (first.version, second.version) == (CONTROL_VERSION, 1)
            assert peer.features == frozenset()
            await old.send('{"t":"Teleport","where":"mars"}')  # of a later release: passed over
            await old.send(encode(Left(id="u/r", reason="of old")))
            while not isinstance(message := await master.messages.get(), Left):
                pass
            assert message.reason == "of old"
        await robots.channel.login("still here", "r", "p")


async def test_orders_of_a_later_master_are_passed_over() -> None:
    taken: asyncio.Queue[ToTaskSet] = asyncio.Queue()

    async def serve_one(socket: ServerConnection) -> None:
        await socket.recv()
        await socket.send(encode(Welcome(version=CONTROL_VERSION, master="m")))
        await socket.send('{"t":"Teleport","where":"mars"}')
        await socket.send(encode(Notify(id="u", text="after it")))
        await socket.wait_closed()

    async with serve(serve_one, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        channel = TaskSetChannel(f"ws://127.0.0.1:{port}", SECRET, hello, taken.put, timeouts=QUICK)
        task = asyncio.create_task(channel.run())
        try:
            while not isinstance(message := await taken.get(), Notify):
                pass
            assert message.text == "after it"
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_refusal_is_logged_and_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    master.refuse = "no room"
    async with master.server, TaskSet(master.server.port).running() as robots:
        while "refuses this task set: no room" not in caplog.text:
            await asyncio.sleep(0.01)
        assert not robots.channel.connected
        master.refuse = ""
        await robots.channel.wait_connected()
        assert master.story == ["hello"]


async def test_a_fenced_master_takes_no_message() -> None:
    is_fenced = False
    master = Master()
    master.server._is_fenced = lambda: is_fenced
    async with master.server, asyncio.timeout(30):
        url = f"ws://127.0.0.1:{master.server.port}"
        async with connect(url, additional_headers=headers(), proxy=None) as task_set:
            await task_set.send(encode(hello()))
            for _ in ("Welcome", "Sync"):
                await task_set.recv()
            is_fenced = True
            await task_set.send(encode(Left(id="u/r", reason="bye")))
            await task_set.wait_closed()
            assert task_set.close_code == CloseCode.GOING_AWAY
        await master.gone.get()
        assert master.messages.empty()


async def test_a_content_is_not_given_once_the_lead_is_lost() -> None:
    is_fenced = False

    async def ignore(*_: object) -> None:
        return None

    async def read(_: str, __: int, ___: int) -> tuple[bytes, int]:
        nonlocal is_fenced
        is_fenced = True
        return b"old", 3

    server = ControlServer(
        SECRET,
        on_hello=ignore,
        on_message=ignore,
        on_gone=ignore,
        port=0,
        contents=read,
        is_fenced=lambda: is_fenced,
    )
    async with server:
        client = ContentClient(Masters(f"ws://127.0.0.1:{server.port}"), SECRET)
        with pytest.raises(ContentError, match="leads no more"):
            await client.piece("0" * 64, 0)
