"""Connections nobody knows yet: who fills the lobby turns out their own."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.guard.lobby import Guest, Lobby, address_of


class Visitors:
    """Connections to a lobby, and which of them are open."""

    def __init__(self, lobby: Lobby) -> None:
        self.lobby = lobby
        self.open: dict[int, Guest] = {}
        self.count = 0

    def come(self, address: str) -> int | None:
        number = self.count = self.count + 1
        guest = self.lobby.enter(address, lambda: self.open.pop(number))
        if guest is None:
            return None
        self.open[number] = guest
        return number


def test_silent_ones_give_way_to_new_ones_of_their_address() -> None:
    visitors = Visitors(Lobby("test", per_address=3, in_all=100))
    held = [visitors.come("evil") for _ in range(3)]
    other = visitors.come("good")
    new = visitors.come("evil")
    assert set(visitors.open) == {*held[1:], other, new}
    assert visitors.lobby.turned_away == 1


def test_those_who_spoke_stay_and_the_new_one_must_go() -> None:
    visitors = Visitors(Lobby("test", per_address=2, in_all=100))
    for _ in range(2):
        number = visitors.come("a")
        assert number is not None
        visitors.open[number].speak()
    assert visitors.come("a") is None
    assert len(visitors.open) == len(visitors.lobby) == 2
    assert visitors.come("b") is not None


def test_known_ones_are_not_counted() -> None:
    visitors = Visitors(Lobby("test", per_address=2, in_all=4))
    for _ in range(50):
        number = visitors.come("proxy")
        assert number is not None
        visitors.open[number].speak()
        visitors.open[number].leave()
        visitors.open[number].leave()
    assert len(visitors.open) == 50
    assert len(visitors.lobby) == 0
    assert visitors.lobby.turned_away == 0


def test_a_full_lobby_turns_out_of_the_largest_crowd() -> None:
    visitors = Visitors(Lobby("test", per_address=8, in_all=10))
    crowd = [visitors.come("crowd") for _ in range(7)]
    few = [visitors.come(f"10.0.0.{n}") for n in range(3)]
    late = visitors.come("late")
    assert set(visitors.open) == {*crowd[1:], *few, late}


def test_the_log_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    visitors = Visitors(Lobby("robots", per_address=2, in_all=10))
    with caplog.at_level(logging.WARNING):
        for _ in range(20):
            visitors.come("evil")
    assert [r.getMessage() for r in caplog.records] == [
        "robots: 2 connections from evil do not say who they are"
    ]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 3)), max_size=60))
def test_bounds_hold_and_nothing_is_kept_of_those_who_left(steps: list[tuple[str, int]]) -> None:
    lobby = Lobby("test", per_address=3, in_all=5)
    visitors = Visitors(lobby)
    for address, what in steps:
        if what < 2 or not visitors.open:
            visitors.come(address)
        elif what == 2:
            next(iter(visitors.open.values())).speak()
        else:
            number = next(iter(visitors.open))
            visitors.open.pop(number).leave()
        addresses = [guest.address for guest in visitors.open.values()]
        assert len(lobby) == len(addresses) <= 5
        assert all(addresses.count(a) <= 3 for a in "abc")
    for guest in visitors.open.values():
        guest.leave()
    assert not lobby._guests
    assert not lobby._silent
    assert not lobby._complained


@pytest.mark.parametrize(
    ("peer", "address"),
    [
        (("10.1.2.3", 5), "10.1.2.3"),
        (("::ffff:10.1.2.3", 5, 0, 0), "10.1.2.3"),
        (("2001:db8:1:2:3:4:5:6", 5, 0, 0), "2001:db8:1:2::/64"),
        (("fe80::1%eth0", 5, 0, 2), "fe80::/64"),
        ("", ""),
        (None, ""),
    ],
)
def test_address(peer: object, address: str) -> None:
    assert address_of(peer) == address
