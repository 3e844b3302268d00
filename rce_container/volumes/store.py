"""The volumes on a machine: ``STATE/volumes/USER/NAME.img``, or a folder ``NAME`` where images do not work.

One container at a time has a volume: it is *claimed* from the start of a container until its last process has
ended, also across restarts of the manager. While its files are saved or restored, it is claimed too.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rce.control import VolumePlacement
from rce.model import Volume, about
from rce_container.exceptions import VolumeError
from rce_container.volumes import images, measuring
from rce_container.volumes.places import SETTLE_S, VolumePlaces


class VolumeMount(NamedTuple):
    """A volume of a container that is started."""

    variable: str
    """Environment variable with its path."""
    source: Path
    """Its folder, or its image."""
    path: str
    """Where the container sees it."""
    image: bool


class Claim(NamedTuple):
    """A volume that a container has."""

    id: str
    """``user/name``."""
    path: str
    """Where the container sees it."""
    size: int
    """Bytes; 0 if it is not known."""
    snapshots: int = 0
    """Seconds between two snapshots; 0: none."""
    placement: int = 0
    """Number of the placement that its files belong to."""


class VolumeStore:
    """The volumes of one container task set.

    Args:
        folder: Holds them.
        images: Whether new volumes are images; else they are folders that are watched.

    Attributes:
        places: Their files.
        used: Bytes that the volumes hold, by ``user/name``, as last measured.
    """

    def __init__(self, folder: Path, *, images: bool) -> None:
        self.places = VolumePlaces(folder, images=images)
        self._images = images
        self._claims: Mapping[str, tuple[Claim, ...]] = {}
        """By incarnation. Replaced with each change: a thread that measures may be reading it."""
        self._doomed: set[str] = set()
        """Volumes to be removed when their container has ended."""
        self.used: dict[str, int] = {}
        self._faults: dict[str, str] = {}
        """Why a folder holds more than was measured, by ``user/name``."""

    # Claims

    def claim(
        self,
        user: str,
        incarnation_id: str,
        volumes: Iterable[Volume],
        placements: Sequence[VolumePlacement] = (),
    ) -> tuple[VolumeMount, ...]:
        """Give volumes to a container that is about to start; make their folders. Quick.

        Args:
            user: The container's user.
            incarnation_id: Its incarnation.
            volumes: What it asks for.
            placements: Which files it is to have; none from a master of an earlier release.

        Raises:
            VolumeError: One belongs to a container that has not ended yet, or cannot be used; or this machine
                has not the files that count.
        """
        numbers = {placement.name: placement for placement in placements}
        claims, mounts = [], []
        for volume in volumes:
            id_ = f"{user}/{volume.name}"
            self._check_free(id_, volume)
            placement = numbers.get(volume.name)
            if placement is not None:
                self._check_placement(id_, placement)
            mounts.append(self._mount_of(id_, volume))
            claims.append(_claim_of(id_, volume, placement))
        if claims:
            self._note_claims(incarnation_id, tuple(claims))
        return tuple(mounts)

    def adopt(self, user: str, incarnation_id: str, volumes: Mapping[str, str]) -> None:
        """Note the volumes of a container that an earlier manager started.

        Args:
            user: The container's user.
            incarnation_id: Its incarnation.
            volumes: Their paths in the container, by name.
        """
        if volumes:
            claims = (Claim(f"{user}/{name}", path, 0) for name, path in volumes.items())
            self._note_claims(incarnation_id, tuple(claims))

    def note(
        self,
        user: str,
        incarnation_id: str,
        volumes: Iterable[Volume],
        placements: Iterable[VolumePlacement] = (),
    ) -> None:
        """Note what is desired of the volumes of an adopted container, which its record does not hold."""
        numbers = {placement.name: placement for placement in placements}
        desired = {
            claim.id: claim
            for volume in volumes
            for claim in (_claim_of(f"{user}/{volume.name}", volume, numbers.get(volume.name)),)
        }
        known = self._claims.get(incarnation_id, ())
        if known:
            self._note_claims(incarnation_id, tuple(desired.get(claim.id, claim) for claim in known))

    def claims(self, incarnation_id: str) -> tuple[Claim, ...]:
        """Return the volumes of a container."""
        return self._claims.get(incarnation_id, ())

    def hold(self, id_: str) -> str:
        """Keep a volume from being given to a container; return what :meth:`release` takes.

        Raises:
            VolumeError: A container has it, or it is being removed.
        """
        if id_ in self._doomed or self._holder(id_) is not None:
            raise VolumeError(f"volume {id_!r} belongs to a container that has not ended yet")
        holder = f"hold {id_}"
        self._note_claims(holder, (Claim(id_, "", 0),))
        return holder

    def release(self, incarnation_id: str) -> list[str]:
        """Take the volumes of a container that has ended; return those that are to be deleted now."""
        ended = [claim.id for claim in self.claims(incarnation_id) if claim.id in self._doomed]
        self._claims = {id_: own for id_, own in self._claims.items() if id_ != incarnation_id}
        self._doomed.difference_update(ended)
        return [id_ for id_ in ended if self._discard(id_)]

    def prepare(self, incarnation_id: str) -> None:
        """Make the file systems of a container's volumes, or let them grow. Blocks, possibly for minutes.

        The container must have them until this has returned.

        Raises:
            VolumeError: A former container still has one mounted, another program is enlarging one, or the
                disk is full.
        """
        deadline = time.monotonic() + SETTLE_S
        for claim in self._claims.get(incarnation_id, ()):
            image = self.places.image(claim.id)
            if self.places.folder(claim.id).is_dir():
                continue
            if not image.exists():
                images.make(image, claim.size)
                continue
            images.wait_until_unused(image, deadline)
            images.grow(image, claim.size, deadline)

    def _check_placement(self, id_: str, placement: VolumePlacement) -> None:
        if self.places.exists(id_) and self.places.placement(id_) >= placement.number:
            return
        if not placement.is_new:
            raise VolumeError(
                f"the files of volume {placement.name!r} are not on this machine any more; move the "
                "container to the machine that has them, or remove the volume"
            )
        if placement.number:
            try:
                self.places.note_placement(id_, placement.number)
            except OSError as error:
                raise VolumeError(f"cannot write {error.filename}: {error.strerror}") from error

    # Removal

    def doom(self, id_: str) -> bool:
        """Remove a volume; return whether :meth:`VolumePlaces.delete_removed` can delete its files.

        If a container has it, it is removed at :meth:`release`.
        """
        if self._holder(id_) is not None:
            self._doomed.add(id_)
            return False
        return self._discard(id_)

    def replace(self, id_: str, new: Path, placement: int, snapshot: str) -> None:
        """Put a filled volume in the place of a former one (:meth:`VolumePlaces.replace`). Blocks."""
        self._forget(id_)
        self.places.replace(id_, new, placement, snapshot)

    def _forget(self, id_: str) -> None:
        self.used.pop(id_, None)
        self._faults.pop(id_, None)

    def _discard(self, id_: str) -> bool:
        self._forget(id_)
        return self.places.discard(id_)

    # Measuring

    def measure(self, pids: Mapping[str, int]) -> list[tuple[str, str]]:
        """Measure all volumes of running containers, and once those of others. Blocks.

        Args:
            pids: A process in the namespaces of each container, by incarnation; 0 without namespaces.

        Returns:
            The incarnations with a folder that holds more than its size, and what to tell their users.
        """
        over = []
        for incarnation_id, claims in self._claims.items():
            for claim in claims:
                self._measure(claim.id, pids.get(incarnation_id, 0), claim.path)
                if text := self._excess(claim):
                    over.append((incarnation_id, text))
        for id_ in self.places.existing():
            if id_ not in self.used:
                self._measure(id_, 0, "")
        return over

    def check_room(self, incarnation_id: str) -> None:
        """Measure the volumes of a container again that held too much when they were last measured. Blocks.

        Others are measured while it runs: that takes long in a folder with many files.

        Raises:
            VolumeError: One holds too much.
        """
        for claim in self.claims(incarnation_id):
            if self._excess(claim):
                self._measure(claim.id, 0, "")
                if text := self._excess(claim):
                    raise VolumeError(text)

    def _excess(self, claim: Claim) -> str:
        """Return what to tell the user of a folder that held too much when it was measured; else nothing."""
        if not claim.size or not self.places.folder(claim.id).is_dir():
            return ""
        used, fault = self.used.get(claim.id, 0), self._faults.get(claim.id, "")
        return _too_full(claim.id, used, claim.size, fault) if fault or used > claim.size else ""

    def _measure(self, id_: str, pid: int, path: str) -> None:
        with contextlib.suppress(OSError, VolumeError):  # it was removed, or its container ended just now
            place, image = self.places.folder(id_), self.places.image(id_)
            if place.is_dir():
                self.used[id_], fault = measuring.measure(place)
                self._faults[id_] = fault
            elif pid:
                found = os.statvfs(f"/proc/{pid}/root{path}")
                if found.f_blocks * found.f_frsize <= image.stat().st_size:  # else it is not mounted yet
                    self.used[id_] = (found.f_blocks - found.f_bfree) * found.f_frsize
            elif image.exists() and self._holder(id_) is None:
                self.used[id_] = images.used(image)

    # Places

    def _check_free(self, id_: str, volume: Volume) -> None:
        if id_ in self._doomed:
            raise VolumeError(f"the former volume {volume.name!r} is still being removed")
        if self._holder(id_) is not None:
            raise VolumeError(f"volume {volume.name!r} belongs to a container that has not ended yet")

    def _mount_of(self, id_: str, volume: Volume) -> VolumeMount:
        place, image = self.places.folder(id_), self.places.image(id_)
        if image.exists() and not self._images:
            raise VolumeError(
                f"volume {volume.name!r} is a file system, and this machine cannot mount it any more; "
                "its operator can start the engine as root"
            )
        try:
            self.places.make_folder(place.parent)
            if not self._images or place.is_dir():
                place.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise VolumeError(f"cannot make {error.filename}: {error.strerror}") from error
        if place.is_dir():
            return VolumeMount(volume.variable, place, volume.path, image=False)
        return VolumeMount(volume.variable, image, volume.path, image=True)

    def _holder(self, id_: str) -> str | None:
        return next((holder for holder, own in self._claims.items() if any(c.id == id_ for c in own)), None)

    def _note_claims(self, holder: str, claims: tuple[Claim, ...]) -> None:
        self._claims = {**self._claims, holder: claims}


def _claim_of(id_: str, volume: Volume, placement: VolumePlacement | None) -> Claim:
    number = 0 if placement is None else placement.number
    return Claim(id_, volume.path, volume.size, volume.snapshots, number)


def _too_full(id_: str, used: int, size: int, fault: str) -> str:
    name = id_.partition("/")[2]
    if fault:
        return (
            f"volume {name!r} may hold {about(size)}, and what it holds cannot be measured: {fault}; remove "
            f"the volume (rce volume remove {name})"
        )
    return (
        f"volume {name!r} holds {about(used)} and may hold {about(size)}; create the container with a larger "
        f"size for it, or remove the volume (rce volume remove {name})"
    )
