"""Life cycles as tables."""

from __future__ import annotations

from enum import Enum, IntEnum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.lifecycle import REMEMBERED, InvalidTransitionError, LifeCycle, remember


class Door(Enum):
    OPEN = "open"
    CLOSED = "closed"
    LOCKED = "locked"
    GONE = "gone"


class Act(Enum):
    OPEN = "open it"
    SHUT = "shut it"
    LOCK = "lock it"
    UNLOCK = "unlock it"
    BURN = "burn it"


DOOR: LifeCycle[Door, Act] = LifeCycle(
    "door",
    {
        Door.OPEN: {Act.SHUT: Door.CLOSED, Act.BURN: Door.GONE},
        Door.CLOSED: {Act.OPEN: Door.OPEN, Act.LOCK: Door.LOCKED, Act.BURN: Door.GONE},
        Door.LOCKED: {Act.UNLOCK: Door.CLOSED, Act.BURN: Door.GONE},
        Door.GONE: {},
    },
)


def test_the_table_says_what_follows() -> None:
    assert DOOR.advance(Door.OPEN, Act.SHUT) is Door.CLOSED
    assert DOOR.allows(Door.CLOSED, Act.LOCK)
    assert not DOOR.allows(Door.OPEN, Act.LOCK)


def test_an_impossible_event_tells_what_came_before() -> None:
    front = DOOR.start(Door.OPEN, "front")
    front.advance(Act.SHUT)
    front.advance(Act.LOCK)
    with pytest.raises(InvalidTransitionError) as caught:
        front.advance(Act.OPEN)
    assert str(caught.value) == (
        "door front is locked: expected unlock it or burn it, found open it;"
        " the events before were shut it, lock it"
    )
    assert caught.value.recent == (Act.SHUT, Act.LOCK)
    assert caught.value.possible == (Act.UNLOCK, Act.BURN)
    assert front.state is Door.LOCKED
    assert front.recent == (Act.SHUT, Act.LOCK)


def test_an_end_allows_nothing() -> None:
    with pytest.raises(InvalidTransitionError, match=r"is gone: expected none, found burn it;.* were none"):
        DOOR.advance(Door.GONE, Act.BURN)


def test_a_life_cycle_raises_its_own_error() -> None:
    class DoorError(InvalidTransitionError):
        pass

    cycle = LifeCycle("door", DOOR.table, error=DoorError)
    with pytest.raises(DoorError):
        cycle.start(Door.OPEN).advance(Act.LOCK)


def test_states_without_texts_are_named() -> None:
    class Light(IntEnum):
        RED = 0
        GREEN = 1

    cycle: LifeCycle[Light, Light] = LifeCycle(
        "light", {Light.RED: {Light.GREEN: Light.GREEN}, Light.GREEN: {}}
    )
    with pytest.raises(InvalidTransitionError, match=r"^light is GREEN: expected none, found RED"):
        cycle.advance(Light.GREEN, Light.RED)


def test_a_table_without_a_row_is_refused() -> None:
    with pytest.raises(ValueError, match="the life cycle of a door has no row for closed"):
        LifeCycle("door", {Door.OPEN: {Act.SHUT: Door.CLOSED}})


def test_the_table_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        DOOR.table[Door.GONE][Act.OPEN] = Door.OPEN  # type: ignore[index]  # the table cannot be changed


@given(st.lists(st.sampled_from(Act), max_size=50))
def test_a_state_machine_goes_where_the_table_says(acts: list[Act]) -> None:
    machine, state = DOOR.start(Door.OPEN), Door.OPEN
    done: list[Act] = []
    for act in acts:
        if machine.allows(act):
            state = DOOR.table[state][act]
            assert machine.advance(act) is state
            done += [act] if done[-1:] != [act] else []
        else:
            with pytest.raises(InvalidTransitionError):
                machine.advance(act)
        assert machine.state is state
        assert machine.recent == tuple(done[-REMEMBERED:])


def test_remember_keeps_the_newest() -> None:
    recent: tuple[Act, ...] = ()
    for number in range(REMEMBERED + 3):
        recent = remember(recent, Act.OPEN if number % 2 else Act.SHUT)
    assert recent == (Act.OPEN, Act.SHUT) * (REMEMBERED // 2 - 1) + (Act.OPEN, Act.SHUT)
    assert remember(recent, Act.BURN) == (*recent[1:], Act.BURN)


def test_remember_takes_repetitions_as_one() -> None:
    assert remember(remember((Act.OPEN,), Act.SHUT), Act.SHUT) == (Act.OPEN, Act.SHUT)
