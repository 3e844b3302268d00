"""The choice of a machine among all, also those that do not take the container."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rce.model.specs import Resources
from rce_master.state.placement import Room, best_of


def choose(
    rooms: Iterable[Room],
    requested: Resources,
    *,
    company: Mapping[str, int] | None = None,
    own: Mapping[str, int] | None = None,
) -> Room | None:
    """Choose the machine for a container; None if it fits nowhere."""
    return best_of((room for room in rooms if room.fits(requested)), requested, company=company, own=own)
