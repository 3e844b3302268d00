"""A program's serialized messages travel in one frame where the engine knows how, else in two."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rce_client import Serialized
from rce_robot.doors.client import gate
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    from integration.client.conftest import Engine

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"


class Counted:
    """What endpoints of this process got and sent, as first bytes of binary frames, and texts of messages."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.marks: list[bytes] = []
        self.texts = 0
        deliver = RobotSocket._deliver

        def delivered(socket: RobotSocket, opcode: int, data: bytes) -> None:
            if opcode == 1:
                self.texts += b'"DM"' in bytes(data)
            else:
                self.marks.append(bytes(data[:1]))
            deliver(socket, opcode, data)  # type: ignore[arg-type]  # it asks for an Opcode of its own

        patch.setattr(RobotSocket, "_deliver", delivered)


@pytest.mark.parametrize("known", [True, False], ids=["endpoint-knows", "older-endpoint"])
async def test_raw_topics_and_services(engine: Engine, monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    """With an older endpoint, which ignores the feature, everything works in two frames."""
    counted = Counted(monkeypatch)
    if not known:
        monkeypatch.setattr(gate, "read_features", lambda _query: frozenset())
    got: asyncio.Queue[bytes] = asyncio.Queue()

    async def reverse(request: Serialized) -> bytes:
        return bytes(request)[::-1]

    async def double(payload: bytes) -> bytes:
        return payload + payload

    async with engine.connection() as conn:
        assert conn.takes_single_frames is known
        publisher = await conn.publisher("say", STRING, raw=True)
        await conn.subscriber("hear", STRING, lambda message: got.put_nowait(bytes(message)), raw=True)
        client = await conn.service_client("ask", ECHO, raw=True)
        await conn.service_provider("serve", ECHO, reverse, raw=True)
        for tag in ("say", "hear", "ask", "serve"):
            await conn.wait_active(tag, 30)
        engine.end("ask").answer = double
        for payload in (b"", b"small", bytes(2_000_000)):
            publisher.publish(payload)
            assert await engine.end("say").received.get() == payload
            engine.end("hear").port.send(payload)
            assert await got.get() == payload
        publisher.publish(b"kept", latch="1")
        assert await engine.end("say").received.get() == b"kept"
        engine.end("hear").port.send(b"latched", latched=True)
        assert await got.get() == b"latched"
        assert bytes(await client(b"ab")) == b"abab"
        assert await engine.end("serve").port.call(b"abc") == b"cba"
    assert len(counted.marks) == 6
    assert set(counted.marks) == {b"\x01"} if known else b"\x01" not in counted.marks
    assert counted.texts == (0 if known else 6)


async def test_form_is_agreed_on_again_with_each_connection(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The endpoint that a client finds after a loss may be older."""
    counted = Counted(monkeypatch)
    async with engine.connection() as conn:
        publisher = await conn.publisher("say", STRING, raw=True)
        await publisher.wait_active(30)
        publisher.publish(b"one")
        assert await engine.end("say").received.get() == b"one"
        monkeypatch.setattr(gate, "read_features", lambda _query: frozenset())
        await engine.kick()
        await conn._session.until(lambda: not conn.takes_single_frames)
        await publisher.wait_active(30)
        publisher.publish(b"two")
        assert await engine.end("say").received.get() == b"two"
    assert counted.marks[0] == b"\x01"
    assert counted.marks[1] != b"\x01"
