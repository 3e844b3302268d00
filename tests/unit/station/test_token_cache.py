"""What the station remembers of tokens: strangers and busy programs displace no user's."""

from __future__ import annotations

import pytest

from rce_fleet.station import token_cache
from rce_fleet.station.authentication import StationUser
from rce_fleet.station.token_cache import TokenCache

ANNA, BERT = StationUser("anna", "operator"), StationUser("bert", "operator")


def test_tokens_that_are_not_valid_displace_no_users() -> None:
    cache = TokenCache()
    cache.put("good", ANNA, 1.0)
    for number in range(3 * token_cache.MAX_CACHED):
        cache.put(f"bad{number}", None, 2.0)
    assert cache.known("good", 0.0) == ANNA
    assert (cache.is_refused("bad0", 0.0), cache.is_refused("bad2999", 0.0)) == (False, True)


def test_a_user_with_many_tokens_loses_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(token_cache, "MAX_CACHED", 3)
    cache = TokenCache()
    cache.put("annas", ANNA, 1.0)
    for number in range(5):
        cache.put(f"berts{number}", BERT, 2.0)
    assert cache.known("annas", 0.0) == ANNA
    assert [cache.known(f"berts{number}", 0.0) is not None for number in range(5)] == [False] * 3 + [True] * 2


def test_only_the_last_answer_about_a_token_counts() -> None:
    cache = TokenCache()
    cache.put("one", ANNA, 1.0)
    assert (cache.known("one", 1.0), cache.is_refused("one", 0.0)) == (None, False)
    cache.put("one", None, 2.0)
    assert (cache.known("one", 0.0), cache.is_refused("one", 1.0), cache.is_refused("one", 2.0)) == (
        None,
        True,
        False,
    )
    cache.put("one", BERT, 3.0)
    assert (cache.known("one", 2.0), cache.is_refused("one", 0.0)) == (BERT, False)
    cache.forget("one")
    assert cache.known("one", 0.0) is None
