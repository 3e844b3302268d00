"""Where a container fits, and which machine is taken: the pure rules."""

from __future__ import annotations

from random import Random
from typing import Any, Unpack

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.parts import MachineParts
from support.placement import choose

from rce.control.messages import MachineInfo
from rce.model.specs import Network, Resources
from rce_master.state.placement import DETOUR, Room, refusals

MB = 1 << 20
SHORT_OF_MEMORY = "m1 has 40 of 100 MB memory free, 50 MB needed"


def room(
    process: str = "m1",
    *,
    slots_used: int = 0,
    cpu_used: float = 0.0,
    memory_used: int = 0,
    draining: bool = False,
    **machine: Unpack[MachineParts],
) -> Room:
    return Room(
        process=process,
        machine=MachineInfo(name=process, **machine),
        slots=slots_used,
        cpu=cpu_used,
        memory=memory_used,
        draining=draining,
    )


@pytest.mark.parametrize(
    ("where", "requested", "reason"),
    [
        (room(cores=2, cpu_used=0.5), {"cpu": 4.0}, "m1 has 1.5 of 2 cores free, 4 needed"),
        (room(slots=4, slots_used=3), {"size": 2}, "m1 has 1 of 4 slots free, 2 needed"),
        (room(memory=100 * MB, memory_used=60 * MB), {"memory": 50 * MB}, SHORT_OF_MEMORY),
        (room(memory=100 * MB, slots=2, memory_used=60 * MB), {}, SHORT_OF_MEMORY),
        (room(labels=("lidar",)), {"special_features": ("gpu", "lidar")}, "m1 lacks the label gpu"),
        (room(), {"network": Network.GROUP}, "m1 has no network group"),
        (room(runtimes=("namespace",)), {"image": "debian:12"}, "m1 has no podman for the image debian:12"),
        (room(draining=True), {}, "m1 is draining"),
        (
            room(cores=1, slots=1, slots_used=1),
            {"cpu": 2.0},
            "m1 has 0 of 1 slots free, 1 needed and has 1 of 1 cores free, 2 needed",
        ),
    ],
)
def test_what_is_missing_is_named(where: Room, requested: dict[str, Any], reason: str) -> None:
    assert where.why_not(Resources(**requested)) == reason
    assert not where.fits(Resources(**requested))


def test_what_a_machine_does_not_count_it_has_enough_of() -> None:
    assert room().fits(Resources(size=1000, cpu=1000.0, memory=1 << 50))


def test_fractions_of_cores_add_up_to_whole_ones() -> None:
    machine = room(cores=1)
    for _ in range(10):
        assert machine.fits(Resources(cpu=0.1))
        machine = machine.with_(Resources(cpu=0.1))
    assert not machine.fits(Resources(cpu=0.1))


def test_only_what_grows_must_find_room() -> None:
    full = room(cores=1, slots=2, cpu_used=3.0, slots_used=1)
    had = Resources(cpu=2.0)
    assert full.shortages(Resources(cpu=1.5), had) == []
    assert full.shortages(Resources(cpu=1.5, size=2), had) == ["has 1 of 2 slots free, 2 needed"]
    assert full.shortages(Resources(cpu=2.5), had) == ["has 0 of 1 cores free, 2.5 needed"]


def test_the_machine_that_is_left_least_loaded_is_taken() -> None:
    small, large = room("small", slots=4), room("large", slots=40, slots_used=4)
    assert choose([small, large], Resources()) == large
    tight = room("tight", slots=100, memory=100 * MB, memory_used=90 * MB)
    assert choose([tight, small], Resources(memory=1 * MB)) == small


def test_company_is_worth_a_detour_but_no_more() -> None:
    empty, there = room("a", slots=100), room("b", slots=100, slots_used=10)
    assert choose([empty, there], Resources(), company={"b": 1}) == there
    crowded = room("b", slots=100, slots_used=10 + int(100 * DETOUR))
    assert choose([empty, crowded], Resources(), company={"b": 9}) == empty


def test_among_equals_a_user_stays_together_and_else_spreads() -> None:
    a, b = room("a", slots=10), room("b", slots=10)
    assert choose([a, b], Resources(), own={"b": 1}) == b
    assert choose([a, b.with_(Resources())], Resources(), own={"b": 1}) == a


def test_a_long_list_of_refusals_is_cut() -> None:
    text = refusals([room(f"m{n}", draining=True) for n in range(20)], Resources())
    assert text.count(";") == 8
    assert text.endswith("and 12 more machines")


REQUESTS = st.builds(
    Resources,
    size=st.integers(1, 4),
    cpu=st.sampled_from([0.0, 0.1, 0.5, 2.0]),
    memory=st.integers(0, 4).map(lambda n: n * 32 * MB),
    special_features=st.sampled_from([(), ("gpu",)]),
)
ROOMS = st.lists(
    st.builds(
        room,
        st.sampled_from("abcdef"),
        slots=st.integers(0, 8),
        cores=st.integers(0, 4),
        memory=st.integers(0, 8).map(lambda n: n * 32 * MB),
        labels=st.sampled_from([(), ("gpu",)]),
        draining=st.booleans(),
    ),
    unique_by=lambda made: made.process,
    max_size=5,
)


@given(ROOMS, st.lists(REQUESTS, max_size=12))
def test_no_machine_is_ever_promised_more_than_it_has(rooms: list[Room], requests: list[Resources]) -> None:
    found = {made.process: made for made in rooms}
    for requested in requests:
        chosen = choose(found.values(), requested)
        if chosen is None:
            assert not any(each.fits(requested) for each in found.values())
            assert len(refusals(found.values(), requested, most=99).split("; ")) == max(1, len(found))
            continue
        assert not chosen.draining
        assert set(requested.special_features) <= set(chosen.machine.labels)
        found[chosen.process] = chosen.with_(requested)
        assert all(share <= 1 + 1e-6 for share in found[chosen.process].shares.values())
        assert found[chosen.process].without(requested).load == pytest.approx(chosen.load)


@given(ROOMS, st.lists(REQUESTS, max_size=9))
def test_filling_a_machine_at_once_is_filling_it_one_by_one(
    rooms: list[Room], requests: list[Resources]
) -> None:
    for each in rooms:
        filled = each
        for requested in requests:
            filled = filled.with_(requested)
        assert each.filled(requests) == filled


@given(ROOMS, REQUESTS, st.randoms())
def test_the_choice_does_not_depend_on_the_order(
    rooms: list[Room], requested: Resources, random: Random
) -> None:
    shuffled = list(rooms)
    random.shuffle(shuffled)
    assert choose(rooms, requested) == choose(shuffled, requested)


@given(ROOMS, REQUESTS)
def test_the_quick_answers_are_those_of_the_texts(rooms: list[Room], requested: Resources) -> None:
    for each in rooms:
        assert each.fits(requested) == (not each.why_not(requested))
        assert each.load_with(requested) == pytest.approx(each.with_(requested).load)
