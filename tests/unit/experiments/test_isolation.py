"""What robot 1's program sees and does, by a core and a graph that are driven by hand."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain, repeat
from threading import Thread
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from rce_fleet.experiments.isolation import deeds, is_ended, reached, to_add
from rce_fleet.experiments.systems.multi_master import MultiMaster
from rce_fleet.experiments.workloads import core_api
from rce_fleet.experiments.workloads import reach as module
from rce_fleet.experiments.workloads.core_api import CoreApi
from rce_fleet.experiments.workloads.reach import Reach
from rce_fleet.experiments.workloads.robot_base import RobotBase
from rce_fleet.experiments.workloads.telling import reports

STATE = [[["/Robot2/scan", ["/Robot2_base_1"]]], [["/map", ["/Robot1_base_1"]]], []]


class Graph:
    """Notes what is asked for."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def output(self, topic: str, kind: str) -> Graph:
        del kind
        self.asked.append(topic)
        return self

    def send(self, fields: object, stamp: object = None) -> None:
        del stamp
        self.asked.append(f"sent {fields}")

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        del kind, callback
        self.asked.append(service)

    def take(self, *_: object) -> None: ...

    def provide(self, *_: object) -> None: ...

    def run(self, *_: object) -> None: ...


@contextmanager
def core(slave: str = "", *, hidden: int = 0) -> Iterator[tuple[str, list[str]]]:
    """A core that is every node's slave API too; gives its URI, and who was told to end.

    Args:
        slave: URI of the slave API of all nodes, if it is another one.
        hidden: How often its nodes are asked for before it has some.
    """
    told: list[str] = []
    topics = ("/Robot2/scan", "/Robot20/scan", "/Robot2/cmd_vel")
    states = chain(repeat([[], [], []], hidden), repeat(STATE))

    def look_up(_caller: str, name: str) -> str:
        told.append(name)
        return slave or uri

    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        uri = f"http://127.0.0.1:{server.server_address[1]}/"
        answers: dict[str, Callable[..., object]] = {
            "getPublishedTopics": lambda *_: [[name, "a/B"] for name in topics],
            "getSystemState": lambda *_: next(states),
            "getParamNames": lambda *_: ["/Robot2/max_speed", "/rosversion"],
            "getPid": lambda *_: 1,
            "lookupNode": look_up,
            "shutdown": lambda *_: 0,
        }
        for name, answer in answers.items():
            server.register_function(lambda *given, answer=answer: [1, "", answer(*given)], name)
        server.register_function(lambda *_: [-1, "not allowed", 0], "setParam")
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield uri, told
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("hidden", [0, 1])
def test_a_program_looks_tries_and_ends_the_others_nodes(
    hidden: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is shared late is seen at the second look; the program's own topic never counts."""
    monkeypatch.setattr(module, "SECONDS", 0.2)
    graph = Graph()
    with core(hidden=hidden) as (uri, told):
        reach = Reach(graph, CoreApi("/reach", uri), CoreApi("/reach", "http://127.0.0.1:1/"), 2)
        reach.step()
        assert graph.asked == ["/Robot2/cmd_vel"]
        reach.step()
        assert graph.asked[1:] == ["sent {}", "/Robot2/enable"]
        time.sleep(0.2)
        reach.step()
        reach.step()
    assert told == ["/Robot2_base_1"]
    seen, end = reports(capsys.readouterr().out.splitlines())
    assert seen == {
        "topics_visible": 2,
        "topics_others": 1,
        "nodes_others": 1,
        "parameters_others": 1,
        "can_use_core": 0,
        "nodes_told_to_end": 1,
    }
    assert is_ended([seen])
    assert end == {"phase": "end"}


def test_a_refusing_node_is_not_told_and_a_silent_one_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A program that is slow on a busy machine must not count as one that cannot be ended."""
    monkeypatch.setattr(core_api, "END_S", 0.2)
    with core("http://127.0.0.1:1/") as (uri, _):
        assert not CoreApi("/reach", uri).end_node("/Robot2_base_1")
    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        core(f"http://127.0.0.1:{silent.getsockname()[1]}/") as (uri, _),
        pytest.raises(TimeoutError),
    ):
        CoreApi("/reach", uri).end_node("/Robot2_base_1")


def test_a_refusal_of_the_core_is_an_error() -> None:
    with core() as (uri, _):
        assert CoreApi("/reach", uri).answers()
        with pytest.raises(OSError, match="setParam: not allowed"):
            CoreApi("/reach", uri).set_parameter("/a", 1)


def test_a_base_tells_once_what_was_done_to_it(capsys: pytest.CaptureFixture[str]) -> None:
    base = RobotBase()
    for _ in range(2):
        base.move(None)
        assert base.enable() == {"success": True}
    assert list(reports(capsys.readouterr().out.splitlines())) == [{"moved": True}, {"called": True}]


def test_deeds_are_known_by_what_the_other_robot_tells() -> None:
    seen: list[dict[str, object]] = [{"topics_others": 2, "nodes_told_to_end": 1}, {"phase": "end"}]
    found = reached(seen, [{"moved": True}])
    assert {name: value for name, value, _ in found} == {
        "topics_others": 2.0,
        "can_publish": 1.0,
        "can_call": 0.0,
        "can_end_nodes": 0.0,
    }


def test_files_and_lines_of_one_more_robot_are_counted() -> None:
    files, lines = to_add(MultiMaster.wiring(2))
    assert files.value == 1
    assert lines.value == 10


class Slow:
    """A program whose end is told only when its lines are read for the third time."""

    def __init__(self) -> None:
        self.reads = 0

    async def lines(self) -> list[str]:
        self.reads += 1
        return ['report {"moved": true}', 'report {"ended": true}'][: 1 + (self.reads > 2)]


async def test_the_end_of_a_node_is_waited_for_where_it_was_told_to() -> None:
    assert is_ended([{"nodes_told_to_end": 1}, {"phase": "end"}])
    assert not is_ended([{"nodes_others": 1, "nodes_told_to_end": 0}])
    slow: Any = Slow()
    assert await deeds(slow, 0.0) == [{"moved": True}]
    assert await deeds(slow, 30.0) == [{"moved": True}, {"ended": True}]
