"""The records of what outlives a run of a container: volumes, their moves, and saved states of nodes.

All are immutable and go to the store: a change replaces a record.
"""

from __future__ import annotations

from msgspec import Struct

from rce_master.state.lifecycle import VolumeMovePhase


class UserVolume(Struct, frozen=True, kw_only=True):
    """A folder of a user's on a container machine, which outlives the containers that write to it."""

    user: str
    name: str
    size: int
    """Bytes that it may hold."""
    process: str = ""
    """Of the container task set on whose machine it is; empty until its first container is placed."""
    placement: int = 0
    """Grows each time that it gets another machine: of the folders on several machines, the one of the newest
    placement counts."""
    is_restored: bool = False
    """Whether this placement began with the files of a snapshot."""
    former: tuple[str, ...] = ()
    """Task sets with folders of earlier placements, which are kept until its container is up at this one."""
    is_returned: bool = False
    """Whether this placement is at a machine of an earlier one, because its container failed at the last."""
    snapshots: int = 0
    """Seconds between two snapshots, as its newest container asked for; 0: none."""
    snapshot: str = ""
    """SHA-256 of the manifest of the newest snapshot, which the masters hold; empty: there is none."""
    kept: int = 0
    """Bytes of that snapshot."""
    taken: float = 0.0
    """When it was taken; seconds since 1970."""
    fault: str = ""
    """Why there was no snapshot when one was due; empty: there was."""

    @property
    def id(self) -> str:
        """``user/name``."""
        return user_volume_key(self.user, self.name)


def user_volume_key(user: str, name: str) -> str:
    """Tell the key of a volume."""
    return f"{user}/{name}"


class VolumeMove(Struct, frozen=True, kw_only=True):
    """A container that moves with its volumes to another machine; it runs nowhere meanwhile."""

    id: str
    """Of the container. Its task set is still the former one; empty if that was lost."""
    to: str
    """Process name of the task set that gets it; empty while it rests."""
    phase: VolumeMovePhase
    done: tuple[str, ...] = ()
    """Names of the volumes that this phase is done with."""
    since: float = 0.0
    """When this phase began; seconds of the clock that commands are applied with, set anew by each master."""


class VolumeRemoval(Struct, frozen=True, kw_only=True):
    """A volume whose files a task set still has to remove; kept until it says that they are gone."""

    process: str
    volume: str
    """``user/name``."""

    @property
    def id(self) -> str:
        """Its key."""
        return volume_removal_key(self.process, self.volume)


def volume_removal_key(process: str, volume: str) -> str:
    """Tell the key of the removal of a volume."""
    return f"{process} {volume}"


class SavedState(Struct, frozen=True, kw_only=True):
    """The newest snapshot of a node's state; the contents are kept under their hash."""

    container: str
    """``user/tag``."""
    node: str
    """Its tag."""
    process: str
    """Of the task set where it was taken."""
    incarnation: str
    """Of the container of which it was taken."""
    number: int
    """Grows from snapshot to snapshot of an incarnation."""
    size: int
    """Bytes."""
    sha256: str
    """In hex."""
    taken: float
    """When it came; seconds since 1970."""

    @property
    def id(self) -> str:
        """``user/container/node``."""
        return saved_state_key(self.container, self.node)

    @property
    def user(self) -> str:
        """The user it belongs to."""
        return self.container.partition("/")[0]


def saved_state_key(container: str, node: str) -> str:
    """Tell the key of the saved state of a node."""
    return f"{container}/{node}"
