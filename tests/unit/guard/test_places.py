"""Places of streams: so many for each holder, so many for all."""

from __future__ import annotations

import pytest

from rce.guard import NoPlaceError, Places


def test_places_are_counted_for_each_holder_and_in_all() -> None:
    places = Places(each=2, most=3)
    with places.place("anna"), places.place("anna"):
        with pytest.raises(NoPlaceError, match="all 2") as own, places.place("anna"):
            pass
        with (
            places.place("bert"),
            pytest.raises(NoPlaceError, match="all 3") as others,
            places.place("cleo"),
        ):
            pass
    assert (own.value.is_own, others.value.is_own) == (True, False)
    assert len(places) == 0
    with places.place("cleo"), places.place("cleo"):
        assert len(places) == 2


def test_a_place_is_free_after_an_error() -> None:
    places = Places(each=1)
    for _ in range(3):
        with pytest.raises(KeyError), places.place("anna"):
            raise KeyError
    assert len(places) == 0


def test_without_limits_all_have_places() -> None:
    places = Places(each=0)
    with places.place("anna"), places.place("anna"):
        assert len(places) == 2
