"""Runs of the fault suite: their choices, and what ends a scenario."""

from __future__ import annotations

import asyncio
import itertools
import sys
import tempfile
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from faults import __main__ as runs
from faults import clients, task_sets
from faults.answers import losing_proxies
from faults.catalogue import Scenario
from faults.clients import REGISTER_USERS, Clients
from faults.goals import WITH_ETCD, Times
from faults.history import Fate, History
from faults.networks import between
from faults.scenarios import kill, network
from faults.task_sets import Prober
from faults.world import World
from support.engine import until
from support.networks import NetworkMachine
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as serving

from rce.control import decode_to_master, encode
from rce.control.messages import ClientReply, ClientRequest, Welcome

SEED = 7
CHOICES = 20


def made_world(writers: Clients | None = None, scale: float = 1.0) -> World:
    return World(cast("Any", None), cast("Any", writers), History(), Times(), SEED, scale)


async def written(user: str, monkeypatch: pytest.MonkeyPatch, *, before: int = 0) -> tuple[list[str], World]:
    """Return what a writer chooses, and its world, after another one has made so many choices."""
    writers = Clients(cast("Any", SimpleNamespace(machines=[SimpleNamespace(url="")])), History(), SEED)
    world = made_world(writers)
    kinds: list[str] = []

    async def ask(*request: Any) -> tuple[Fate, dict[str, Any]]:
        kinds.extend(request[-1])
        await asyncio.sleep(0)
        return Fate.DONE, {}

    monkeypatch.setattr(writers, "_ask", ask)
    monkeypatch.setattr(clients, "PAUSE_S", 0.0)
    for name, count in ((REGISTER_USERS[0], before), (user, CHOICES)):
        kinds.clear()
        writing = asyncio.create_task(writers._write(name, 0))
        while len(kinds) < count:
            await asyncio.sleep(0)
        writing.cancel()
        await asyncio.gather(writing, return_exceptions=True)
    return kinds[:CHOICES], world


async def test_a_seed_repeats_choices_however_often_others_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    user = REGISTER_USERS[1]
    first, world = await written(user, monkeypatch)
    again, other_world = await written(user, monkeypatch, before=5)
    assert first == again
    fresh = made_world().rng.random()
    assert world.rng.random() == other_world.rng.random() == fresh


async def test_each_proxy_chooses_by_itself_what_it_loses() -> None:
    machines = [SimpleNamespace(name=name, address="127.0.0.1") for name in ("m1", "m2")]
    async with losing_proxies(cast("Any", machines), "127.0.0.1", SEED) as proxies:
        first = {proxy.rng.random() for proxy in proxies}
    async with losing_proxies(cast("Any", machines), "127.0.0.1", SEED) as proxies:
        reverse = {proxy.rng.random() for proxy in reversed(list(proxies))}
    assert len(first) == 2
    assert first == reverse


@pytest.mark.parametrize("error", [OSError("the disk is gone"), AssertionError("a write was lost")])
def test_an_error_in_a_scenario_ends_only_that_one(
    error: Exception, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = (tmp_path / str(number) for number in itertools.count())

    def make_folder(**_: object) -> str:
        folder = next(folders)
        folder.mkdir()
        return str(folder)

    async def run(scenario: Scenario, *_: object) -> None:
        if scenario.name == "first":
            raise error

    scenarios = [Scenario(name, cast("Any", None)) for name in ("first", "second")]
    monkeypatch.setattr(runs, "SCENARIOS", scenarios)
    monkeypatch.setattr(runs, "_run", run)
    monkeypatch.setattr(tempfile, "mkdtemp", make_folder)
    monkeypatch.setattr(sys, "argv", ["faults", "--seed", "1"])
    assert runs.main() == 1
    said = capsys.readouterr().out
    assert str(error) in said
    assert "--- second" in said
    assert "until the next write" in said
    assert said.splitlines()[-1] == "failed with seed 1: first"


async def test_each_kind_of_kill_is_done_25_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the long run; both processes are on one machine every second time."""
    done: Counter[str] = Counter()

    def counted(name: str) -> Callable[[World], Awaitable[float]]:
        async def kind(_: World) -> float:
            done[name] += 1
            return 0.0

        return kind

    names = ("_kill_leader", "_kill_etcd", "_kill_both", "_kill_one_machine", "_kill_standby")
    for name in names:
        monkeypatch.setattr(kill, name, counted(name))
    world = made_world(scale=100.0)
    monkeypatch.setattr(world.rng, "uniform", lambda *_: 0.0)
    monkeypatch.setattr(World, "whole", counted("whole"))
    await kill.kill(world)
    assert [done[name] for name in names] == [25, 25, 13, 12, 25]


async def test_etcds_leader_is_cut_off_every_second_time(monkeypatch: pytest.MonkeyPatch) -> None:
    done: Counter[tuple[str, bool]] = Counter()

    async def cut(_: World, what: str, __: object, *, with_etcd: bool) -> None:
        done[what, with_etcd] += 1

    monkeypatch.setattr(network, "_cut", cut)
    await network.cut(made_world(scale=100.0))
    assert done == {(what, with_etcd): 6 for what in network.CUTS for with_etcd in (False, True)}


def test_each_cut_of_the_leading_master_has_a_goal() -> None:
    times = Times()
    for what in network.CUTS:
        times.add(what, 1.0)
        times.add(what + WITH_ETCD, 1.0)
    for line in list(times.table())[1:]:
        assert line.split()[-2:] == ["<", "8"]


def test_a_cut_between_two_machines_has_rules_for_each_way() -> None:
    other = NetworkMachine("there", "10.77.0.2", "switch", "port2")
    assert between(other, None, network.BOTH_WAYS) == [
        ("INPUT", "-s", "10.77.0.2"),
        ("OUTPUT", "-d", "10.77.0.2"),
    ]
    assert between(other, 2380, ("INPUT",)) == [
        ("INPUT", "-s", "10.77.0.2", "-p", "tcp", "--sport", "2380"),
        ("INPUT", "-s", "10.77.0.2", "-p", "tcp", "--dport", "2380"),
    ]


async def test_a_prober_notes_when_what_was_answered_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = asyncio.Event()

    async def serve(socket: ServerConnection) -> None:
        await socket.recv()
        await socket.send(encode(Welcome(version=1, master="m1", term=1)))
        request = decode_to_master(await socket.recv())
        assert isinstance(request, ClientRequest)
        await socket.send(encode(ClientReply(request=request.request)))
        await socket.send(encode(Welcome(version=1, master="m1", term=1)))
        await answered.wait()

    history = History()
    async with serving(serve, "127.0.0.1", 0) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        monkeypatch.setattr(task_sets, "CONTROL_PORT", port)
        machine = SimpleNamespace(address="127.0.0.1", name="m1")
        async with Prober(cast("Any", SimpleNamespace(machines=[machine])), history).running():
            await until(lambda: len(history.heard) == 3, timeout=60.0, what="all messages are heard")
        answered.set()
    welcome, reply, follows = history.heard
    assert welcome.after < welcome.at < reply.after < reply.at
    assert follows.after == reply.after
