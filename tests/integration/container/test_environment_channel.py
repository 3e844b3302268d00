"""The transport between managers and environments."""

from __future__ import annotations

import asyncio
import os
import socket

import pytest

from rce_container.environment import channel as module
from rce_container.environment.channel import Channel
from rce_container.environment.exceptions import ChannelError


def pair() -> tuple[Channel, Channel]:
    one, other = socket.socketpair()
    return Channel(one), Channel(other)


async def test_lines_come_in_order_and_whole() -> None:
    one, other = pair()
    lines = [b"", b"x" * 3_000_000, b"short", b"y" * 500_000]

    async def receive() -> list[bytes | None]:
        return [await other.receive() for _ in range(len(lines) + 1)]

    task = asyncio.create_task(receive())
    for line in lines:
        one.send(line)
    while one._unsent:
        await asyncio.sleep(0)
    one.close()
    assert await task == [*lines, None]
    other.close()


async def test_descriptors_come_with_their_lines() -> None:
    one, other = pair()
    reading, writing = os.pipe()
    one.send(b"plain")
    one.send(b"x" * 1_000_000)
    one.send(b"with", writing)
    os.close(writing)
    assert [await other.receive() for _ in range(3)][2] == b"with"
    fd = other.take_fd()
    assert not os.get_inheritable(fd)
    os.write(fd, b"!")
    os.close(fd)
    assert os.read(reading, 9) == b"!"
    os.close(reading)
    with pytest.raises(ChannelError, match="file descriptor"):
        other.take_fd()
    one.close()
    other.close()


async def test_closing_wakes_the_receiver_and_drops_descriptors() -> None:
    one, other = pair()
    task = asyncio.create_task(other.receive())
    await asyncio.sleep(0)
    other.close()
    assert await task is None
    one.send(b"into nothing", 0)
    one.close()
    one.send(b"still nothing")


async def test_a_peer_that_does_not_read_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_UNSENT", 1_000_000)
    one, other = pair()
    for _ in range(20):
        one.send(b"x" * 100_000)
    assert one._closed
    other.close()


async def test_descriptors_for_a_peer_that_does_not_read_are_limited(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_UNSENT_FDS", 10)
    one, other = pair()
    reading, writing = os.pipe()
    one.send(b"x" * 1_000_000)
    for _ in range(11):
        assert not one._closed
        one.send(b"with", writing)
    assert one._closed
    other.close()
    os.close(writing)
    assert os.read(reading, 1) == b"", "all copies of the pipe's other end are closed"
    os.close(reading)


@pytest.mark.parametrize("end", ["read", "close"])
async def test_drain_waits_until_the_peer_reads_or_the_end(end: str) -> None:
    one, other = pair()
    await one.drain(0)
    for _ in range(5):
        one.send(b"x" * 1_000_000)
    draining = asyncio.create_task(one.drain(2))
    for _ in range(10):
        await asyncio.sleep(0)
    assert not draining.done()
    if end == "read":
        for _ in range(4):
            await other.receive()
    else:
        one.close()
    async with asyncio.timeout(60):
        await draining
    one.close()
    other.close()


async def test_a_line_without_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_LINE", 1000)
    one, sock = socket.socketpair()
    other = Channel(sock)
    one.send(b"x" * 5000)
    with pytest.raises(ChannelError, match="more than 1000 bytes"):
        await other.receive()
    one.close()
    other.close()
