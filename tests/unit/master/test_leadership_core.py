"""Who leads, and until when, by a clock that the test sets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_master.exceptions import FencedError, TransitionError
from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings, Role

TTL = 3.0
USABLE = 2.7
"""Of a lease, without the margin."""


def leading(at: float = 100.0, term: int = 4) -> LeadershipCore:
    core = LeadershipCore(LeaseSettings(ttl=TTL))
    core.granted(at, TTL)
    core.elected(term, at + 0.1)
    return core


def test_a_stand_by_becomes_the_leader_by_a_lease_and_a_term() -> None:
    core = LeadershipCore(LeaseSettings())
    assert (core.role, core.look(0.0), core.remaining(0.0)) == (Role.STANDBY, False, 0.0)
    core.granted(100.0, TTL)
    assert (core.role, core.look(100.0)) == (Role.CANDIDATE, False)
    assert core.remaining(101.0) == pytest.approx(1.7)
    core.elected(7, 101.0)
    assert (core.role, core.term, core.look(101.0)) == (Role.LEADING, 7, True)


@pytest.mark.parametrize(
    ("now", "leads"), [(100.2, True), (102.69, True), (102.7, False), (103.0, False), (1e9, False)]
)
def test_the_deadline_counts_from_before_the_request(now: float, leads: bool) -> None:
    core = leading(at=100.0)
    assert core.look(now) is leads
    assert core.role is (Role.LEADING if leads else Role.STEPPING_DOWN)


@pytest.mark.parametrize(
    ("sent", "ttl", "deadline"),
    [
        (101.0, 3.0, 101.0 + USABLE),
        (101.0, 9.0, 101.0 + USABLE),  # etcd gave more than was asked for: not relied on
        (101.0, 2.0, 101.0 + 1.8),
        (99.0, 3.0, 100.0 + USABLE),  # an answer that came late shortens nothing
    ],
)
def test_a_renewal_moves_the_deadline(sent: float, ttl: float, deadline: float) -> None:
    core = leading(at=100.0)
    core.renewed(sent, ttl)
    assert core.deadline == pytest.approx(deadline)


def test_a_lease_that_ended_at_etcd_ends_the_leadership() -> None:
    core = leading()
    core.renewed(101.0, 0)
    assert core.role is Role.STEPPING_DOWN
    core.released()
    assert not core.look(101.0)
    core.granted(102.0, TTL)


def test_a_master_that_was_suspended_leads_no_more() -> None:
    """The answer to a renewal that was sent before the suspension does not help either."""
    core = leading(at=100.0)
    core.renewed(100.5, TTL)
    assert not core.look(1000.0)
    core.renewed(100.6, TTL)
    assert core.role is Role.STEPPING_DOWN


def test_a_candidate_that_took_too_long_does_not_lead() -> None:
    core = LeadershipCore(LeaseSettings(ttl=TTL))
    core.granted(100.0, TTL)
    with pytest.raises(FencedError, match="lease ended while"):
        core.elected(1, 102.7)
    assert core.role is Role.STANDBY


def test_renewals_come_six_times_in_a_lease() -> None:
    core = leading(at=100.0)
    assert core.until_renewal(100.1) == pytest.approx(0.4)
    core.renewed(100.5, TTL)
    assert core.until_renewal(100.5) == pytest.approx(0.5)
    assert core.until_renewal(110.0) == 0.0


def test_what_cannot_happen_changes_nothing() -> None:
    core = LeadershipCore(LeaseSettings())
    with pytest.raises(TransitionError):
        core.released()
    core.resigned()
    core.lost()
    core.renewed(5.0, TTL)
    assert core.role is Role.STANDBY


def test_a_fence_is_of_one_term_only() -> None:
    now = 100.2
    core = leading(at=100.0, term=4)
    fence = Fence(core, lambda: now, "one:9000")
    fence.check()
    core.lost()
    assert fence.is_closed
    core.released()
    core.granted(100.0, TTL)
    core.elected(5, now)
    assert not Fence(core, lambda: now, "one:9000").is_closed
    with pytest.raises(FencedError, match="leads no more"):
        fence.check()


def test_a_leader_that_hears_of_a_newer_term_steps_down() -> None:
    core = leading(at=100.0, term=4)
    fence = Fence(core, lambda: 100.2, "one:9000")
    for term in (0, 3, 4):
        fence.heed(term)
    fence.check()
    with pytest.raises(FencedError, match="leads in term 4, and term 9 has begun"):
        fence.heed(9)
    assert fence.is_closed
    assert core.heard == 9, "the next term is greater"


@given(st.lists(st.tuples(st.sampled_from(["renew", "late", "look"]), st.floats(0, 5)), max_size=30))
def test_no_order_of_events_extends_a_lease_beyond_etcds(events: list[tuple[str, float]]) -> None:
    """Etcd keeps the lease for its whole time from when it got the request, which is after it was sent."""
    core = leading(at=0.0)
    now, kept = 0.1, TTL
    for what, step in events:
        sent = now
        now += step
        if what == "renew" and sent < kept:
            kept = max(kept, sent + TTL)
            core.renewed(sent, TTL)
        elif what == "late":
            core.renewed(sent, 0 if sent >= kept else TTL)
            kept = max(kept, sent + TTL) if sent < kept else kept
        assert not core.look(now) or now < kept


def test_a_drained_stand_by_waits_for_others() -> None:
    core = LeadershipCore(LeaseSettings(drained_wait=10.0))
    assert not core.looked(is_led=True, is_drained=True, now=100.0)
    assert not core.looked(is_led=False, is_drained=True, now=101.0)
    assert not core.looked(is_led=False, is_drained=True, now=110.9)
    assert core.looked(is_led=False, is_drained=True, now=111.0)
    assert core.looked(is_led=False, is_drained=False, now=111.0)


@pytest.mark.parametrize("between", [True, None])
def test_its_wait_begins_anew(between: bool | None) -> None:
    """When another one led meanwhile, or etcd could not be asked."""
    core = LeadershipCore(LeaseSettings(drained_wait=10.0))
    assert not core.looked(is_led=False, is_drained=True, now=101.0)
    assert not core.looked(is_led=between, is_drained=True, now=105.0)
    assert not core.looked(is_led=False, is_drained=True, now=111.0)
    assert core.looked(is_led=False, is_drained=True, now=121.0)


def test_a_stand_by_that_is_not_drained_does_not_wait() -> None:
    core = LeadershipCore(LeaseSettings(drained_wait=10.0))
    assert not core.looked(is_led=None, is_drained=False, now=100.0)
    assert core.looked(is_led=False, is_drained=False, now=101.0)
