"""The benchmark of abuse does not take a probe without an attack for one beside it."""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

import pytest

from benchmarks import abuse, attacks
from benchmarks.abuse import _attacker

REFUSAL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


async def test_an_attack_that_ends_is_an_error() -> None:
    with pytest.raises(RuntimeError, match=r"'no such kind' ended:[\s\S]*KeyError"):
        async with _attacker("no such kind", "ws://127.0.0.1:1/"):
            pass


async def test_an_attack_that_is_always_refused_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(REFUSAL)
        writer.close()

    monkeypatch.setattr(abuse, "START_S", 3.0)
    server = await asyncio.start_server(refuse, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    with pytest.raises(RuntimeError, match="'wrong requests' could do nothing"):
        async with _attacker("wrong requests", f"ws://127.0.0.1:{port}/"):
            pass
    server.close()


class RefusingSocket:
    """A robot's connection to an engine that refuses interfaces."""

    async def send(self, text: str) -> None:
        pass

    async def recv(self) -> str:
        return json.dumps({"type": "ER", "data": "CN: interface 'a0/out' exists with other settings"})


async def test_an_attack_without_its_interfaces_does_not_begin() -> None:
    with pytest.raises(ConnectionError, match="other settings"):
        await attacks.loop_back(cast("Any", RefusingSocket()), attacks.IMAGE)


def test_progress_is_printed_once_a_second(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    times = iter((100.0, 100.5, 101.0))
    monkeypatch.setattr(attacks, "monotonic", lambda: next(times))
    progress = attacks.Progress()
    for _ in range(3):
        progress.add()
    assert capsys.readouterr().out == "progress 1\nprogress 3\n"
