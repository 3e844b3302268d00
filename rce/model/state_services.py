"""The services by which a node's state is kept when its container moves. Pure."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta, Struct, to_builtins

from rce.model import written

MAX_STATE = 16 * 2**20
"""Bytes of a node's state."""
MIN_EVERY, MAX_EVERY = 1.0, 86_400.0
"""Seconds from one snapshot to the next."""
DEFAULT_EVERY = 10.0


class StateServices(Struct, frozen=True, kw_only=True):
    """How a node's state is saved and restored. The names are relative to the node's namespace."""

    save: str
    """A service ``rce_msgs/SaveState`` of the node, which returns its state."""
    restore: str
    """A service ``rce_msgs/RestoreState`` of the node, which takes over such a state."""
    every: float = DEFAULT_EVERY
    """Seconds from one snapshot to the next."""


class WrittenStateServices(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The services as users write them."""

    save: written.RosName
    restore: written.RosName
    every: Annotated[float, Meta(ge=MIN_EVERY, le=MAX_EVERY)] = DEFAULT_EVERY


def read_state_services(given: WrittenStateServices) -> StateServices:
    """Check the services of a node's state.

    Raises:
        ValueError: Both are the same.
    """
    if given.save == given.restore:
        raise ValueError(f"save and restore must be two services, not both {given.save!r:.60}")
    return StateServices(save=given.save, restore=given.restore, every=given.every)


def write_state_services(services: StateServices) -> dict[str, Any]:
    """Write the services as users write them."""
    return dict(to_builtins(services))
