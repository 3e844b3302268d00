"""The processes of reported nodes, as the machine sees them."""

from __future__ import annotations

import pytest

from rce.control.model import EndpointState, EndpointStatus, NodeState, NodeStatus
from rce_container import intake
from rce_container.environment import proc
from rce_container.observed import OuterStatus


@pytest.fixture(autouse=True)
def inner_pids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes have the pids inside that they have outside, less 100."""
    monkeypatch.setattr(proc, "inner_pid", lambda pid: pid - 100)


def report(*pids: int) -> EndpointStatus:
    nodes = tuple(NodeStatus(tag=f"n{pid}", state=NodeState.RUNNING, pid=pid) for pid in pids)
    return EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING, nodes=nodes)


class Container:
    """A container with processes, and what its reports cost."""

    def __init__(self, *pids: int) -> None:
        self.pids = list(pids)
        self.now = 100.0
        self.searches = 0
        self.pace = intake.Pace(lambda: 0.0)
        self._outer = OuterStatus(self._list, lambda: self.now)

    def _list(self) -> list[int]:
        self.searches += 1
        return self.pids

    def report(self, *pids: int) -> tuple[int | None, ...]:
        return tuple(node.pid for node in self._outer.replace(report(*pids), self.pace).nodes)


def test_pids_are_those_outside() -> None:
    container = Container(107, 108)
    assert container.report(7, 8, 9) == (107, 108, 0)
    assert container.report(8) == (108,)
    assert container.searches == 1


def test_a_search_costs_as_much_as_there_are_processes() -> None:
    container = Container(*range(1000, 11_000))
    container.pace.pay(intake.BURST - 5_000_000)
    assert container.pace.pause == 0
    container.report(1)
    assert container.pace.pause > 0


def test_a_pid_that_was_not_found_is_not_searched_for_at_once() -> None:
    container = Container(107)
    assert container.report(7, 8) == (107, 0)
    container.pids.append(108)
    container.now += 0.5
    assert container.report(7, 8) == (107, 0)
    assert container.searches == 1
    container.now += 0.6
    assert container.report(7, 8) == (107, 108)
    assert container.searches == 2


def test_another_pid_is_searched_for_at_once() -> None:
    container = Container(107)
    container.report(7, 8)
    container.pids.append(109)
    assert container.report(7, 8, 9) == (107, 0, 109)
    assert container.report(7, 8, 9) == (107, 0, 109)
    assert container.searches == 2
