"""What a synchronization registers at its master: what it holds, and what it tells remote subscribers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, NamedTuple

import pytest
from support.multimaster import STRING, node
from support.ros_busy_node import answering_second_call

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError
from rce.ros.multimaster import registrar
from rce.ros.multimaster.plan import Registration, RegistrationKind
from rce.ros.multimaster.registrar import Registrar
from rce.ros.multimaster.source import multicall_as
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

ORIGINS = tuple(f"http://10.0.0.{number}:11311/" for number in (1, 2, 3))


class Made(NamedTuple):
    """A registrar and its master."""

    core: Core
    registrar: Registrar

    def topics(self) -> set[str]:
        """The topics that remote nodes publish."""
        return {topic for topic, _ in self.core.graph.published() if topic.startswith("/remote")}


@pytest.fixture
async def made() -> AsyncIterator[Made]:
    async with (
        Core(port=0) as core,
        node("sync", core.uri) as sync,
        RpcClient() as rpc,
        TaskScope() as tasks,
    ):
        yield Made(core, Registrar(sync, MasterClient(core.uri, sync.name, sync.uri, rpc), tasks))


def publisher(number: int, topic: str = "a") -> Registration:
    name = f"/remote{number}"
    kind = RegistrationKind.PUBLISHER
    return Registration(kind, f"{name}/{topic}", name, f"http://10.0.0.{number}:1/", STRING)


async def test_what_is_registered_already_is_held_after_a_restore(made: Made) -> None:
    """The master may be the same one, whose run id another program has set or deleted."""
    entry = publisher(1)
    await made.registrar.hold(ORIGINS[0], {entry}, {})
    await made.registrar.restore()
    assert made.registrar.held == {ORIGINS[0]: {entry}}
    await made.registrar.release(ORIGINS[0])
    assert made.topics() == set()
    assert made.core.graph.parameters.get("/sync/registrations") == {}


async def test_node_registered_since_the_restart_is_restored_whole(made: Made) -> None:
    first, second = publisher(1), publisher(1, "b")
    await made.registrar.hold(ORIGINS[0], {first}, {})
    made.core.forget_node(first.node)  # as a master that was restarted
    await made.registrar.hold(ORIGINS[0], {first, second}, {})
    await made.registrar.restore()
    assert made.topics() == {first.name, second.name}
    assert made.registrar.held == {ORIGINS[0]: {first, second}}


async def test_failed_restore_forgets_no_entry(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may fail before it comes to a master, or after that one's entries were registered."""
    entries = {origin: {publisher(number)} for number, origin in enumerate(ORIGINS, 1)}
    for origin, wanted in entries.items():
        await made.registrar.hold(origin, wanted, {})
        made.core.forget_node(next(iter(wanted)).node)
    calls = 0

    async def failing_second(*arguments: Any) -> list[Any]:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise MasterUnreachableError(made.core.uri, "no answer")
        return await multicall_as(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(registrar, "multicall_as", failing_second)
        with pytest.raises(MasterUnreachableError):
            await made.registrar.restore()
    await made.registrar.restore()
    assert made.topics() == {"/remote1/a", "/remote2/a", "/remote3/a"}
    assert made.registrar.held == entries


async def test_node_here_that_took_the_name_meanwhile_stays(made: Made) -> None:
    entry = publisher(1)
    await made.registrar.hold(ORIGINS[0], {entry}, {})
    made.core.forget_node(entry.node)
    async with node("remote1", made.core.uri) as here:
        await here.advertise("own", STRING)
        await made.registrar.restore()
        assert made.core.graph.nodes["/remote1"] == here.uri
        assert made.registrar.held == {}


async def test_late_call_to_a_remote_subscriber_tells_later_publishers(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A repeated call must not take back what the master has told the subscriber meanwhile."""
    monkeypatch.setattr(registrar, "RETRY", Backoff(first=0.01, longest=0.01))
    calls: asyncio.Queue[bytes] = asyncio.Queue()
    uri = made.core.uri
    async with (
        asyncio.timeout(60),
        node("first", uri) as first,
        node("later", uri) as later,
        answering_second_call(calls, loses=True) as busy,
    ):
        await first.advertise("/t", STRING)
        remote = Registration(RegistrationKind.SUBSCRIBER, "/t", "/busy", busy, STRING)
        await made.registrar.hold(ORIGINS[0], {remote}, {"/t": ["http://10.0.0.1:1/"]})
        async with made.registrar._lock:  # so that it is not repeated before the other publisher comes
            while calls.empty():
                await asyncio.sleep(0.01)
            await later.advertise("/t", STRING)
        while calls.qsize() < 3:  # of the master, and the repeated one
            await asyncio.sleep(0.01)
        told = [calls.get_nowait() for _ in range(3)]
        assert first.uri.encode() in told[0]
        assert all(later.uri.encode() in one for one in told[1:])
        assert sum(b"http://10.0.0.1:1/" in one for one in told) == 2
