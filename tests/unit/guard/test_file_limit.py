"""The limit of open files."""

from __future__ import annotations

import resource
from typing import TYPE_CHECKING

import pytest

from rce.own_process import raise_file_limit

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def low_limit() -> Iterator[int]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    low = min(soft, 512)
    resource.setrlimit(resource.RLIMIT_NOFILE, (low, hard))
    yield low
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_limit_is_raised_as_far_as_it_may(low_limit: int) -> None:
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    allowed = raise_file_limit()
    assert allowed == resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    assert allowed in (hard, 1 << 20)


def test_a_refusal_is_no_failure(low_limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("not allowed")

    monkeypatch.setattr(resource, "setrlimit", refuse)
    assert raise_file_limit() == low_limit
    monkeypatch.undo()
