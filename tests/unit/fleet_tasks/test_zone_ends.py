"""Ends of zones, set by the API or at the planner: which side follows, and when a zone is gone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.planner_copy import RUN, SPILL, Both

from rce_fleet.manager.planner_sync import SetZone


def test_zones_expire_in_journal_and_planner() -> None:
    both = Both()
    both.book.emit(replace(SPILL, until=both.now + 10), "zone", both.now)
    assert len(both.step()) == 1
    assert both.step(20.0) == [SetZone("spill", None)]
    assert both.book.zones == {}


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_new_end_set_during_silence_is_sent(is_killed: bool) -> None:
    """The planner is silent when a request prolongs a zone, and is heard again, unless the manager ends."""
    both = Both()
    both.book.emit(replace(SPILL, until=1100.0, unsent=True), "zone", both.now)
    both.step()
    assert both.confirm() == 1
    both.facts.is_live = False
    later = replace(SPILL, until=2000.0, revision=2, unsent=True)
    both.book.emit(later, "zone", both.now)
    both.step()
    assert both.confirm() == 0
    both.facts.is_live = True
    if is_killed:
        zones = both.facts.zones
        both = Both(both.book)
        both.facts.zones = zones
    both.sync.adopt(both.now)
    assert both.confirm() == 0
    assert both.step() == [SetZone("spill", later)]
    assert both.confirm() == 1
    assert (both.step(200.0), both.book.zones["spill"].until) == ([], 2000.0)


def test_an_unsent_end_survives_the_planners_end() -> None:
    both = Both()
    both.book.emit(replace(SPILL, until=1100.0), "zone", both.now)
    both.step()
    later = replace(SPILL, until=2000.0, revision=2, unsent=True)
    both.book.emit(later, "zone", both.now)
    both.facts.zones.clear()
    assert both.step(200.0) == [SetZone("spill", later)]


@pytest.mark.parametrize("lifetime", [60.0, 3.0, None])
def test_a_zone_prolonged_at_the_planner_stays(lifetime: float | None) -> None:
    """A program renews its zone at the planner well before its end; then it stops that."""
    both = Both()
    renew_s = 30.0 if lifetime is None else lifetime / 3
    for _ in range(20):
        both.facts.zones["gate"] = replace(SPILL, id="gate", until=lifetime and both.now + lifetime)
        assert both.step(renew_s) == []
        assert set(both.book.zones) == {"gate"}
    kept = both.book.zones["gate"]
    assert kept.until is None if lifetime is None else kept.until is not None and kept.until > both.now
    both.facts.zones.clear()
    assert (both.step(), both.book.zones) == ([], {})


@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_zone_prolonged_during_silence_stays(is_restarted: bool) -> None:
    """A program prolongs its zone while the manager does not hear the planner, or was ended."""
    both = Both()
    both.facts.zones["gate"] = replace(SPILL, id="gate", until=1060.0)
    both.step()
    if is_restarted:
        both = Both(both.book)
    both.facts.is_live = False
    both.step(70.0)
    assert both.book.zones == {}
    both.facts.zones["gate"] = replace(SPILL, id="gate", until=both.now + 50.0)
    both.facts.is_live = True
    if is_restarted:
        both.sync.begin(RUN, both.now)
    assert (both.step(), set(both.book.zones)) == ([], {"gate"})


def test_a_zone_that_ended_during_silence_stays_gone() -> None:
    both = Both()
    both.facts.zones["gate"] = replace(SPILL, id="gate", until=1060.0)
    both.step()
    both.facts.is_live = False
    both.step(70.0)
    both.facts.is_live = True
    before = both.book.number
    assert (both.step(), both.book.number) == ([], before)


def test_a_zone_made_permanent_at_the_planner_stays() -> None:
    both = Both()
    both.book.emit(replace(SPILL, until=1100.0), "zone", both.now)
    both.step()
    both.facts.zones["spill"] = replace(both.facts.zones["spill"], until=None)
    assert (both.step(), both.book.zones["spill"].until) == ([], None)
    both.sync.begin(replace(RUN, started="2.0"), both.now)
    both.facts.zones.clear()
    assert [call.zone and call.zone.until for call in both.step() if isinstance(call, SetZone)] == [None]


@pytest.mark.parametrize("late", [-5.0, 0.5, 5.0])
def test_late_messages_change_no_end_of_a_zone(late: float) -> None:
    both = Both()
    both.book.emit(replace(SPILL, until=1100.0), "zone", both.now)
    both.step()
    both.facts.zones["spill"] = replace(both.facts.zones["spill"], until=1100.0 + late)
    before = both.book.number
    both.step(90.0)
    assert both.book.number == before


def test_an_end_just_sent_is_not_taken_for_a_change() -> None:
    """The planner accepted an earlier end, and its state of that is still on the way."""
    both = Both()
    both.book.emit(replace(SPILL, until=1100.0), "zone", both.now)
    both.step()
    seen = both.facts.zones["spill"]
    both.book.emit(replace(SPILL, until=1030.0, revision=2, unsent=True), "zone", both.now)
    assert len(both.step()) == 1
    both.confirm()
    both.facts.zones["spill"] = seen
    assert (both.step(1.0), both.book.zones["spill"].until) == ([], 1030.0)


def test_a_zone_that_ends_very_late_keeps_its_end() -> None:
    both = Both()
    both.book.emit(replace(SPILL, until=1e11), "zone", both.now)
    assert len(both.step()) == 1
    assert (both.step(1000.0), both.book.zones["spill"].until) == ([], 1e11)
