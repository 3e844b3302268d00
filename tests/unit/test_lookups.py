"""Name lookups in threads of their own: shared, bounded, and left behind by programs that do not wait."""

from __future__ import annotations

import asyncio
import socket
import threading

import pytest

from rce.lookups import Info, Lookups

ADDRESS: Info = (socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.1", 80))


class Names:
    """A name server that answers when a test says so."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self._answers: dict[str, threading.Event] = {}

    def __call__(self, host: str, *_: object) -> list[Info]:
        self.asked.append(host)
        assert self.event(host).wait(60)
        if host.startswith("bad"):
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        if host.startswith("long"):
            host.encode("idna")
        return [ADDRESS]

    def event(self, host: str) -> threading.Event:
        return self._answers.setdefault(host, threading.Event())


async def asking(lookups: Lookups, names: Names, *hosts: str) -> list[asyncio.Task[list[Info]]]:
    """Ask for hosts; returns once no more of them are being looked up."""
    tasks = [asyncio.create_task(lookups.addresses(host, 80)) for host in hosts]
    async with asyncio.timeout(60):
        while len(names.asked) < min(lookups.threads, len(set(hosts))) or not lookups.threads:
            await asyncio.sleep(0.001)
    return tasks


async def test_one_lookup_serves_all_who_ask_for_a_name() -> None:
    names = Names()
    lookups = Lookups(4, names)
    tasks = await asking(lookups, names, *["a"] * 10)
    names.event("a").set()
    assert await asyncio.gather(*tasks) == [[ADDRESS]] * 10
    assert names.asked == ["a"]


async def test_lookup_goes_on_for_the_others_when_one_is_cancelled() -> None:
    names = Names()
    lookups = Lookups(4, names)
    first, second = await asking(lookups, names, "a", "a")
    first.cancel()
    await asyncio.wait([first])
    names.event("a").set()
    assert await second == [ADDRESS]


async def test_each_waiter_gets_an_error_of_its_own() -> None:
    names = Names()
    lookups = Lookups(4, names)
    tasks = await asking(lookups, names, "bad", "bad")
    names.event("bad").set()
    errors = await asyncio.gather(*tasks, return_exceptions=True)
    assert [str(error) for error in errors] == [f"[Errno {socket.EAI_NONAME}] Name or service not known"] * 2
    assert errors[0] is not errors[1]


async def test_name_that_cannot_be_encoded_is_refused() -> None:
    names = Names()
    name = f"long{'x' * 64}.example"
    names.event(name).set()
    with pytest.raises(UnicodeError):
        await Lookups(4, names).addresses(name, 80)


async def test_names_without_an_answer_take_few_threads() -> None:
    """Those that wait for a thread are looked up in order, and not at all if the asker went away."""
    names = Names()
    lookups = Lookups(2, names)
    tasks = await asking(lookups, names, "a", "b", "c", "d")
    assert lookups.threads == 2
    tasks[2].cancel()
    await asyncio.wait([tasks[2]])
    for host in ("a", "b", "d"):
        names.event(host).set()
    assert [await task for task in (tasks[0], tasks[1], tasks[3])] == [[ADDRESS]] * 3
    assert names.asked == ["a", "b", "d"]


async def test_own_name() -> None:
    assert await Lookups().own_name() == socket.getfqdn()


async def test_system_without_threads_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    names = Names()
    lookups = Lookups(2, names)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", start)
        with pytest.raises(OSError, match="can't start new thread"):
            await lookups.addresses("a", 80)
    names.event("a").set()
    assert await lookups.addresses("a", 80) == [ADDRESS]


def test_closed_event_loop_is_passed_over() -> None:
    """A later loop of the same program gets the answer to a question that an earlier one asked."""
    names = Names()
    lookups = Lookups(2, names)

    async def leave() -> None:
        (task,) = await asking(lookups, names, "a")
        task.cancel()
        await asyncio.wait([task])

    async def stay() -> list[Info]:
        task = asyncio.create_task(lookups.addresses("a", 80))
        await asyncio.sleep(0)
        names.event("a").set()
        return await task

    asyncio.run(leave())
    assert asyncio.run(stay()) == [ADDRESS]
    assert names.asked == ["a"]


async def test_any_exception_of_a_lookup_is_an_answer() -> None:
    """A port beyond all limits ends neither the thread nor the wait for it."""
    lookups = Lookups(1)
    async with asyncio.timeout(60):
        with pytest.raises(socket.gaierror):
            await lookups.addresses("localhost", 10**40)
        assert await lookups.addresses("127.0.0.1", 80)
