"""The checker of the fault suite: histories that are right, and histories that are not."""

from __future__ import annotations

import asyncio
import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Self, cast

import pytest
from faults.catalogue import SCENARIOS
from faults.clients import Clients
from faults.goals import GOALS, Times
from faults.history import Expected, Fate, Heard, History
from faults.linearizability import Operation, is_linearizable, unexplained
from faults.task_sets import Prober
from hypothesis import given
from hypothesis import strategies as st

INF = math.inf


def write(start: float, end: float, value: int) -> Operation:
    return Operation(start, end, True, value)


def read(start: float, end: float, value: int) -> Operation:
    return Operation(start, end, False, value)


@pytest.mark.parametrize(
    "operations",
    [
        [],
        [write(0, 1, 1), read(2, 3, 1)],
        [write(0, 5, 1), read(1, 2, 0), read(3, 4, 1)],
        [write(0, 5, 1), write(0, 5, 2), read(1, 2, 2), read(3, 4, 1)],
        [write(0, INF, 1), read(50, 51, 1)],
        [write(0, INF, 1), read(50, 51, 0)],
        [write(0, INF, 1), write(2, 3, 2), read(4, 5, 2), read(6, 7, 1)],
    ],
)
def test_histories_that_can_be_explained(operations: list[Operation]) -> None:
    assert is_linearizable(operations, 0)


@pytest.mark.parametrize(
    "operations",
    [
        [write(0, 1, 1), read(2, 3, 0)],
        [read(0, 1, 7)],
        [write(0, 5, 1), read(1, 2, 1), read(3, 4, 0)],
        [write(0, 1, 1), write(2, 3, 2), read(4, 5, 1)],
        [write(0, 5, 1), write(0, 5, 2), read(1, 2, 2), read(3, 4, 1), read(4.5, 4.6, 2)],
        [write(9, INF, 1), read(1, 2, 1)],
    ],
)
def test_histories_that_cannot(operations: list[Operation]) -> None:
    assert not is_linearizable(operations, 0)


def test_a_report_ends_at_what_cannot_be_explained() -> None:
    wrong = [write(0, 1, 1), read(2, 3, 0), read(4, 5, 1)]
    assert unexplained(wrong, 0) == wrong[:2]
    assert unexplained(wrong[2:] + wrong[:1], 0) == []


@st.composite
def histories(draw: st.DrawFn) -> list[Operation]:
    """A register that does one operation after the other, as clients see it that wait before and after."""
    found, value = [], 0
    slack = st.floats(0, 4)
    for number in range(1, draw(st.integers(1, 25))):
        is_write, before, after = draw(st.booleans()), draw(slack), draw(slack)
        value = number if is_write else value
        found.append(Operation(number - before, number + after, is_write, value))
        if is_write and draw(st.integers(0, 3)) == 0:
            found[-1] = replace(found[-1], end=INF)
    return draw(st.permutations(found))


@given(histories())
def test_what_a_register_did_can_be_explained(operations: list[Operation]) -> None:
    assert is_linearizable(operations, 0)


@given(histories())
def test_the_search_agrees_with_trying_every_order(operations: list[Operation]) -> None:
    """Also when one read is falsified."""
    few = sorted(operations, key=lambda each: each.start)[:5]
    reads = [index for index, each in enumerate(few) if not each.is_write]
    if reads:
        few[reads[-1]] = replace(few[reads[-1]], value=1)
    assert is_linearizable(few, 0) == by_trying(few)


def by_trying(operations: list[Operation]) -> bool:
    optional = [each for each in operations if not each.is_certain]
    certain = [each for each in operations if each.is_certain]
    return any(
        explains(order)
        for count in range(len(optional) + 1)
        for chosen in itertools.combinations(optional, count)
        for order in itertools.permutations([*certain, *chosen])
    )


def explains(order: tuple[Operation, ...]) -> bool:
    value = 0
    for index, each in enumerate(order):
        if any(later.end < each.start for later in order[index:]):
            return False
        if each.is_write:
            value = each.value
        elif each.value != value:
            return False
    return True


def test_losses_and_repetitions_are_told() -> None:
    history = History(made={"a": Fate.DONE, "b": Fate.NOT_DONE, "c": Fate.UNKNOWN, "d": Fate.UNKNOWN})
    assert history.violations(["b", "c", "c"], 0) == [
        "a was acknowledged and is lost",
        "b was refused and was done",
        "c was done 2 times",
    ]
    assert history.violations(["a", "d"], 0) == []


def test_messages_of_an_older_term_are_told() -> None:
    history = History(
        heard=[Heard(1, "m1", 1, "Sync"), Heard(5, "m2", 2, "Sync"), Heard(5.1, "m1", 1, "Sync")]
    )
    assert history.violations([], 0) == []
    history.heard.append(Heard(7, "m1", 1, "Sync"))
    assert [text.partition(" came ")[2] for text in history.violations([], 0)] == [
        "2.0 s after a newer term had begun"
    ]


def test_what_a_cut_held_up_is_no_act_of_an_older_term() -> None:
    heard = [Heard(1, "m1", 1, "Sync"), Heard(5, "m2", 2, "Sync"), Heard(12, "m1", 1, "Sync")]
    assert History(heard=heard, cuts=[("m1", 2, 10)]).violations([], 0) == []
    assert History(heard=heard, cuts=[("m2", 2, 10)]).violations([], 0) != []
    assert History(heard=heard, cuts=[("m1", 2, 5)]).violations([], 0) != []


def test_an_answer_to_a_later_request_is_an_act_of_a_cut_master() -> None:
    heard = [Heard(1, "m1", 1, "Sync"), Heard(5, "m2", 2, "Sync"), Heard(12, "m1", 1, "ClientReply", 4.9)]
    assert History(heard=heard, cuts=[("m1", 2, 10)]).violations([], 0) == []
    for late in (Heard(12, "m1", 1, "ClientReply", 5.1), Heard(5.2, "m1", 1, "Welcome", 5.1)):
        history = History(heard=[*heard, late], cuts=[("m1", 2, 10)])
        assert len(history.violations([], 0)) == 1


def test_a_stopped_master_may_have_begun_to_send_one_message() -> None:
    heard = [Heard(1, "m1", 1, "Sync"), Heard(5, "m2", 2, "Sync"), Heard(12, "m1", 1, "Welcome")]
    assert History(heard=heard, stops=[("m1", 11.9)]).violations([], 0) == []
    assert History(heard=heard, stops=[("m2", 11.9)]).violations([], 0) != []
    assert History(heard=heard, stops=[("m1", 11)]).violations([], 0) != []
    assert History(heard=heard, stops=[("m1", 12.1)]).violations([], 0) != []
    second = [*heard, Heard(12.1, "m1", 1, "Sync")]
    assert len(History(heard=second, stops=[("m1", 11.9)]).violations([], 0)) == 1
    assert History(heard=second, stops=[("m1", 11.9), ("m1", 11.8)]).violations([], 0) == []


def test_two_leaders_of_one_term_are_told() -> None:
    history = History(heard=[Heard(1, "m1", 4, "Sync"), Heard(2, "m2", 4, "Sync")])
    assert history.violations([], 0) == ["m1 and m2 both led in term 4"]


def test_the_first_write_after_a_fault_is_one_that_was_asked_for_after_it() -> None:
    history = History()
    history.wrote("x", 1, 3, 1, Fate.DONE)
    history.wrote("x", 2.5, 4, 2, Fate.DONE)
    history.wrote("x", 2.2, 3, 3, Fate.UNKNOWN)
    assert history.first_write_after(2) == 4
    assert history.first_write_after(5) is None


def test_longest_pause_of_writes_begins_at_the_fault_and_ends_at_the_look() -> None:
    history = History()
    for start, end in ((0, 1), (1.5, 2.25), (2, 5), (4, 5.5)):
        history.wrote("x", start, end, 1, Fate.DONE)
    history.wrote("x", 3, 4, 2, Fate.UNKNOWN)
    assert history.longest_pause(2, 6) == 2.75
    assert history.longest_pause(2, 9) == 3.5
    assert history.longest_pause(0.5, 2.5) == 1.25
    assert History().longest_pause(1, 4) == 3


def test_each_time_is_told_beside_its_goal() -> None:
    times = Times()
    for value in (0.5, 0.25, 1.5):
        times.add("SIGTERM of the leading master", value)
    times.add("another fault", 3)
    _, of_goal, without = times.table()
    assert of_goal.split()[-6:] == ["master", "3", "0.50", "1.50", "<", "1"]
    assert without.split() == ["another", "fault", "1", "3.00", "3.00"]
    assert set(GOALS) >= {"SIGTERM of the leading master"}
    times.checked("requests", 20, 1)
    times.checked("requests", 10, 0)
    assert list(times.table())[-1].split() == ["requests", "31", "1", "0"]


def test_scenarios_have_names_of_their_own() -> None:
    names = [each.name for each in SCENARIOS]
    assert len(set(names)) == len(names)
    assert {"kill", "terminate", "upgrade"} <= set(names)


def test_containers_run_as_they_were_acknowledged() -> None:
    history = History(
        containers={"a": Expected.RUNS, "b": Expected.GONE, "c": Expected.EITHER, "d": Expected.EITHER}
    )
    assert history.misplaced(["a", "c"]) == []
    assert history.misplaced([]) == ["container a was acknowledged and does not run"]
    assert history.misplaced(["a", "b", "c", "c", "e"]) == [
        "container b was removed, or refused, and runs",
        "container c runs 2 times",
        "container e runs and was not asked for",
    ]


class Answer:
    """The used part of a master's answer."""

    headers = ()
    content_length = 0

    def __init__(self, status: int) -> None:
        self.status = status

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass


class Session:
    """Gets the same answer to each request."""

    def __init__(self, status: int) -> None:
        self._status = status

    def request(self, *_: object, **__: object) -> Answer:
        return Answer(self._status)


@pytest.mark.parametrize(
    ("before", "status", "lost"),
    [(Expected.RUNS, 404, ["a"]), (Expected.EITHER, 404, []), (Expected.RUNS, 204, [])],
)
async def test_a_container_that_is_not_found_was_lost(before: Expected, status: int, lost: list[str]) -> None:
    history = History(containers={"a": before})
    clients = Clients(cast("Any", SimpleNamespace(machines=[])), history, 1)
    assert await clients._change(cast("Any", Session(status)), "a", "DELETE", "http://m1/")
    assert history.containers == {"a": Expected.GONE}
    assert history.lost_containers == lost
    assert len(history.violations([], 0)) == len(lost)


def test_a_container_that_runs_twice_for_a_while_is_told() -> None:
    history = History()
    for running in (["a", "a"], ["a"], ["a", "b", "b"], ["a", "a", "b"]):  # one was just forked
        history.saw_running(running)
    assert history.violations([], 0) == []
    for running in (["b", "b"], ["b", "b", "b"], ["b"]):
        history.saw_running(running)
    assert history.violations([], 0) == ["container b ran twice for a while"]


def test_registers_are_read_since_a_time_by_answered_reads() -> None:
    history = History()
    history.read("x", 1, 3, 0)
    history.wrote("y", 5, 6, 1, Fate.DONE)
    assert history.read_since(1) == {"x"}
    assert history.read_since(2) == set()
    assert history.reads == 1


async def test_a_prober_that_ends_early_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(*_: object) -> None:
        raise ValueError("not a message")

    monkeypatch.setattr(Prober, "_listen", fail)
    prober = Prober(cast("Any", SimpleNamespace(machines=["m1"])), History())
    with pytest.raises(ValueError, match="not a message"):
        async with prober.running():
            await asyncio.sleep(0)
