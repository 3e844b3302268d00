"""What stops after a fault and for how long, from what a watcher told; the watcher and its provider."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.ownership import command_line, family
from rce_fleet.experiments.robustness import Outage, Robustness, Seen, missing, outage, values_of
from rce_fleet.experiments.workloads.provider import NEW_S, SERVICE, TELL_EVERY, TOPIC, Provider
from rce_fleet.experiments.workloads.telling import READY, reports
from rce_fleet.experiments.workloads.watcher import Watcher


class Graph:
    """Keeps what was asked for."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Mapping[str, Any]]] = []
        self.taken: dict[str, Callable[[Any], None]] = {}
        self.calls: list[Callable[[Any], None]] = []
        self.answer: Callable[[], Mapping[str, Any]] = dict

    def output(self, topic: str, kind: str) -> Any:
        del kind
        return SimpleNamespace(send=lambda fields: self.sent.append((topic, fields)))

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        del kind
        self.taken[topic] = callback

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        assert (service, kind) == (SERVICE, "std_srvs/Trigger")
        self.answer = answer

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        assert (service, kind) == (SERVICE, "std_srvs/Trigger")
        self.calls.append(callback)

    def run(self, step: Callable[[], float]) -> None:
        raise AssertionError(f"driven by hand, not by {step}")


def told(what: str, *times: float) -> list[dict[str, object]]:
    return [{"what": what, "at": at, "number": number} for number, at in enumerate(times)]


@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        ([9.0, 10.5, 11.5, 12.5, 13.5, 14.5], Outage(0.0, True)),
        ([10.5, 13.5, 14.5], Outage(2.0, True)),
        ([9.0, 10.5], Outage(3.5, False)),
        ([], Outage(4.0, False)),
        ([16.0], Outage(4.0, False)),
    ],
)
def test_the_longest_time_without_answer_counts(answers: list[float], expected: Outage) -> None:
    assert outage(answers, 1.0, 10.0, 14.0, 15.0) == expected


def test_each_of_topics_services_and_new_topics_has_its_values() -> None:
    seen = Seen.of([*told("number", 10.0, 10.1, 14.9), *told("call", 10.2), {"ready": 9.0}])
    found = {name: value for name, value, _ in values_of(seen, 10.0, 14.0, 15.0)}
    assert found["topics_stopped"] == pytest.approx(4.7)
    assert (found["topics_came_back"], found["services_came_back"]) == (1.0, 0.0)
    assert found["new_topics_stopped"] == 5.0 - NEW_S
    assert not seen.is_steady(10.0)
    assert Seen.of([*told("number", 11.0), *told("call", 11.0), *told("new", 11.0)]).is_steady(10.0)


def test_numbers_that_never_arrived_are_lost() -> None:
    seen = Seen(numbers=frozenset({0, 1, 3, 4, 5}))
    sent = [{"sent": 2, "at": 10.0}, {"sent": 5, "at": 12.0}, {"sent": 8, "at": 14.8}]
    assert missing(seen, sent, 9.0, 15.0) == 1
    assert missing(seen, [], 9.0, 15.0) is None


def test_a_single_master_system_has_no_master_beside_its_core() -> None:
    setups = Robustness().setups(Options())
    without = [setup for setup in setups if dict(setup.factors)["fault"] == "master_killed"]
    assert {setup.system for setup in without} == {"multi_master", "cloud"}
    first = [setup for setup in setups if setup.software == "ros"]
    assert len(first) == 8
    further = [setup for setup in setups if setup.software == "rce"]
    assert {dict(setup.factors)["fault"] for setup in further} == {"core_killed"}
    assert {setup.system for setup in further} == {setup.system for setup in first}
    assert len(Robustness().setups(Options(quick=True))) == 3


def test_a_provider_makes_topics_after_the_first_call(capsys: pytest.CaptureFixture[str]) -> None:
    graph = Graph()
    provider = Provider(graph, 2)
    for _ in range(TELL_EVERY):
        provider.step()
    assert {topic for topic, _ in graph.sent} == {TOPIC}
    assert next(reports(capsys.readouterr().out.splitlines()))["sent"] == TELL_EVERY
    answer = graph.answer()
    assert graph.answer() == answer
    assert 0 <= time.time() - float(answer["message"]) < NEW_S
    provider.step()
    assert graph.sent[-1][0] == "/new_0"


def test_a_watcher_is_ready_when_all_have_answered(capsys: pytest.CaptureFixture[str]) -> None:
    graph = Graph()
    watcher = Watcher(graph, 2)
    watcher.step()
    graph.taken[TOPIC](SimpleNamespace(data="7"))
    assert list(graph.taken) == [TOPIC]
    graph.calls[0](SimpleNamespace(message=repr(time.time())))
    watcher.step()
    assert len(graph.calls) == 2, "a call does not wait for the former one"
    for _ in range(2):
        graph.taken["/new_0"](None)
    found = list(reports(capsys.readouterr().out.splitlines()))
    assert [(one.get("what"), one.get("number")) for one in found[:-1]] == [
        ("number", 7),
        ("call", 0),
        ("new", 0),
    ]
    assert READY in found[-1]


def test_a_process_has_a_family_and_a_command_line() -> None:
    with subprocess.Popen(["cat", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdin.write(b"\n")
        child.stdin.flush()
        assert child.stdout.readline() == b"\n"  # its command line is empty until it runs
        assert {os.getpid(), child.pid} <= set(family(os.getppid()))
        assert command_line(child.pid).split() == ["cat", "-"]
    assert command_line(2**22 + 1) == ""
