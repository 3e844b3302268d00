"""The usage of containers, and which process belongs to which node."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.cgroup_trees import Tree2

from rce_container.environment import proc
from rce_container.environment.messages import Counters
from rce_container.environment.proc import Process
from rce_container.limits import Limits
from rce_container.limits.cgroup2 import Cgroup2
from rce_container.runtimes.base import Handle
from rce_container.usage import Subject, UsageMeter, sort_out


def process(pid: int, parent: int, session: int) -> Process:
    return Process(pid, 0, parent, session, session, 0.0, 0)


def test_a_node_owns_its_session_and_what_left_it() -> None:
    processes = [
        process(1, 0, 1),  # environment
        process(10, 1, 10),  # node a
        process(11, 10, 10),
        process(12, 11, 12),  # in a session of its own, below the node
        process(13, 12, 12),
        process(14, 1, 10),  # orphaned, still in the node's session
        process(20, 1, 20),  # node b
        process(30, 1, 30),  # a daemon that left everything
    ]
    owners = sort_out({"a": 10, "b": 20, "not started": 0}, processes)
    assert owners == {10: "a", 11: "a", 12: "a", 13: "a", 14: "a", 20: "b"}


def test_a_circle_of_parents_that_a_reused_pid_makes_ends() -> None:
    assert sort_out({"a": 9}, [process(1, 2, 1), process(2, 1, 2)]) == {}


def test_a_fault_costs_one_container_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A container that cannot be measured is logged once; the others are measured."""
    tree = Tree2(tmp_path, monkeypatch, controllers="cpu io memory pids", own="rce.service")
    limiter = Cgroup2("t0", tmp_path / "ledger", tree.proc)
    limiter.probe()
    own = proc.read(os.getpid())
    assert own is not None
    subjects = {
        id_: Subject(Handle(own, id_), limiter.create(id_, Limits()), {}, Counters())
        for id_ in ("bad", "good")
    }
    statistics = tree.own / "rce-t0" / "bad" / "cpu.stat"
    readable = statistics.read_bytes()
    meter = UsageMeter()
    statistics.write_bytes(b"\xff")
    for _ in range(3):
        assert meter.measure(subjects).keys() == {"good"}
    assert [record.getMessage() for record in caplog.records] == [
        "the usage of the container bad cannot be measured"
    ]
    statistics.write_bytes(readable)
    assert meter.measure(subjects).keys() == {"bad", "good"}
