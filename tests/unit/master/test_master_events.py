from __future__ import annotations

import asyncio

from rce_master.events import AT_ONCE, EventLog
from rce_master.state.changes import StateEvent


def state_event(text: str) -> StateEvent:
    return StateEvent("kind", "anna", "anna/c", text)


def test_ids_grow_over_a_restart() -> None:
    old = EventLog(1000.0)
    for _ in range(5):
        old.add(state_event("x"), 1000.0)
    assert EventLog(1000.5).last_id > old.last_id


def test_ids_grow_over_terms_whatever_the_clocks_say() -> None:
    alone = EventLog(1.8e9)
    first, second = EventLog(1.8e9, term=1), EventLog(1.7e9, term=2)
    first.add(state_event("x"), 1.8e9)
    assert alone.last_id < first.last_id < second.last_id < 2**53, "JSON numbers are exact up to there"
    second.add(state_event("y"), 1.7e9)
    assert [event.text for event in second.since(first.last_id)] == ["y"]


def test_events_of_a_user_begin_where_it_was_made() -> None:
    """Whatever the clock says, which may go back meanwhile."""
    log = EventLog(1.8e9)
    assert log.made("anna") == 0, "it was made before this log began"
    log.add(state_event("former"), 1.8e9)
    log.add(StateEvent("user_removed", "", "anna", ""), 1.8e9)
    assert log.made("anna") == 0
    log.add(StateEvent("user_added", "", "anna", "user"), 1.8e9)
    log.add(state_event("new"), 1.7e9)
    assert [event.text for event in log.since(log.made("anna"), user="anna")] == ["new"]


def test_what_a_follower_missed_is_known() -> None:
    log = EventLog(1.0, capacity=3)
    assert log.missed(999) is None
    assert log.missed(5) == 999, "it is an id of the time before"
    log.add(StateEvent("kind", "bert", "bert/c", "first"), 1.0)
    for number in range(4):
        log.add(state_event(str(number)), 1.0)
    assert [event.text for event in log.since(999)] == ["first", "2", "3"]
    assert log.missed(1001) == log.missed(1001, "anna") == 1001
    assert log.missed(5, "anna") == 999
    assert log.missed(1002, "anna") is None
    assert log.missed(999, "bert") is None
    assert log.missed(999, "carl") is None


def test_a_greater_id_than_the_newest_is_of_another_time() -> None:
    """The engine was moved from etcd to SQLite, whose ids are smaller, or its clock was set back."""
    before = EventLog(1.8e9, term=1)
    before.add(state_event("before"), 1.8e9)
    log = EventLog(1.8e9)
    log.add(state_event("first"), 1.8e9)
    assert log.missed(log.last_id) is None
    missed = log.missed(before.last_id, "anna")
    assert missed is not None
    assert [event.text for event in log.since(missed, user="anna")] == ["first"]
    assert log.missed(before.last_id, "carl") == log.missed(before.last_id) == missed


def test_the_ring_keeps_the_newest() -> None:
    log = EventLog(0.0, capacity=3)
    for number in range(5):
        log.add(state_event(str(number)), 0.0)
    assert [e.text for e in log.since(-1)] == ["2", "3", "4"]
    assert [e.text for e in log.since(3)] == ["4"]
    assert [e.text for e in log.since(-1, limit=1)] == ["2"]
    assert log.since(log.last_id) == []
    assert log.since(10**9) == []


async def test_followers_wait_for_news() -> None:
    log = EventLog(0.0)
    waiting = [asyncio.ensure_future(log.wait(log.last_id, 30)) for _ in range(3)]
    await asyncio.sleep(0)
    log.add(state_event("news"), 1.0)
    for found in await asyncio.gather(*waiting):
        assert [e.text for e in found] == ["news"]
    assert await log.wait(log.last_id, 0.01) == []


def test_one_users_flood_costs_nobody_else_their_events() -> None:
    log = EventLog(0.0, capacity=10)
    for text in ("first", "second"):
        log.add(StateEvent("kind", "bert", "bert/c", text), 0.0)
    for number in range(100):
        log.add(state_event(str(number)), 0.0)
    assert [e.text for e in log.since(-1, user="bert")] == ["first", "second"]
    assert [e.text for e in log.since(-1, user="anna")] == [str(number) for number in range(92, 100)]
    assert [e.text for e in log.since(-1, limit=3)] == ["first", "second", "92"]
    assert log.since(-1, user="nobody") == []


class _Counted(int):
    """An id that counts how often ids are compared."""

    compared = 0

    def __lt__(self, other: int) -> bool:
        _Counted.compared += 1
        return int(self) < int(other)


def test_the_past_is_found_in_few_steps() -> None:
    """A follower of 10,000 events asks a hundred times; looking at all events each time blocks others."""
    log = EventLog(0.0)
    for number in range(12_000):
        log.add(state_event(str(number)), 0.0)
    last, texts = _Counted(-1), []
    while found := log.since(last, AT_ONCE, "anna"):
        texts += [event.text for event in found]
        last = _Counted(found[-1].id)
    assert texts == [str(number) for number in range(2_000, 12_000)]
    assert _Counted.compared < 100 * 20
