"""Memory for what is read."""

from __future__ import annotations

import pytest

from rce.buffers import unfilled


@pytest.mark.parametrize("size", [1, 100, 1 << 20])
def test_what_was_filled_is_handed_over_uncopied(size: int) -> None:
    buffer = unfilled(size)
    with buffer.getbuffer() as view:
        assert len(view) == size
        view[:] = b"x" * size
    value = buffer.getvalue()
    assert value == b"x" * size
    assert buffer.getvalue() is value


def test_two_buffers_share_nothing() -> None:
    first, second = unfilled(64), unfilled(64)
    with first.getbuffer() as view:
        view[:] = bytes(64)
    with second.getbuffer() as view:
        view[:] = b"y" * 64
    assert first.getvalue() == bytes(64)
