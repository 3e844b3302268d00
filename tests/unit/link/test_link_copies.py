"""Which connection of a peer that is moved stands beside the present one, and which takes its place."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from rce.control.model import LinkAddress, LinkSpec
from rce.link.carrier import Carrier, LocalCarrier
from rce.link.frames import Frame, FrameType
from rce.link.link import Link
from rce.link.settings import LinkLimits

COPY = LinkSpec(id="L", peer="u/b", token="t", dial=False, address=LinkAddress(), copy=True)


def carrier() -> Carrier:
    return LocalCarrier.pair()[0]


def accepting_copy() -> tuple[Link, list[Carrier]]:
    """Return the link of a copy, and what came to stand beside its connection."""
    beside: list[Carrier] = []
    link = Link(COPY, LinkLimits())
    link.on_successor = beside.append
    return link, beside


async def test_copy_that_took_over_keeps_its_peers_link() -> None:
    """Then the peer is moved too: its copy stands beside it, whatever the peer has sent."""
    link, beside = accepting_copy()
    first, second = carrier(), carrier()
    link.accept(first, standby=True, copy=False)
    link.change(replace(COPY, copy=False))
    link.accept(second, standby=False, copy=True)
    assert beside == [second]
    assert link.carrier is first


@pytest.mark.parametrize("frame", [FrameType.TAKE, FrameType.CALL, FrameType.DATA])
async def test_two_copies_are_linked_until_both_took_over(frame: FrameType) -> None:
    """The other one dials again before it is the endpoint; the next copy stands beside it."""
    link, beside = accepting_copy()
    first, second, third = carrier(), carrier(), carrier()
    link.accept(first, standby=False, copy=True)
    link.change(replace(COPY, copy=False))
    link.accept(second, standby=False, copy=True)
    assert link.carrier is second
    link.frame_received(Frame(frame, 1))
    link.accept(third, standby=False, copy=True)
    assert beside == [third]
    assert link.carrier is second
