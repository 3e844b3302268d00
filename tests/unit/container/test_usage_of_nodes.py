"""Which process belongs to which node."""

from __future__ import annotations

from rce_container.environment.proc import Process
from rce_container.usage import sort_out


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
