"""The volumes on a machine: ``STATE/volumes/USER/NAME.img``, or a folder ``NAME`` where images do not work.

One container at a time has a volume: it is *claimed* from the start of a container until its last process has
ended, also across restarts of the manager. While its files are saved or restored, it is claimed too.

``STATE/volumes/.placements/USER/NAME`` holds the number of the placement that the files belong to.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rce.control import VolumePlacement
from rce.model import Volume, about, is_name
from rce_container.exceptions import VolumeError
from rce_container.files import remove, write_whole
from rce_container.folder import make_accessible
from rce_container.volumes import images
from rce_container.volumes.mounted import open_image, open_inside

_log = logging.getLogger(__name__)

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
_SETTLE_S = 10.0
"""Seconds that a former container's mount may take to end."""


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
        used: Bytes that the volumes hold, by ``user/name``, as last measured.
    """

    def __init__(self, folder: Path, *, images: bool) -> None:
        self._folder = folder
        self._trash = folder / ".removed"
        self._scratch = folder / ".scratch"
        """What is being copied or restored, and what a killed manager left of that."""
        self._placements = folder / ".placements"
        self._images = images
        self._claims: dict[str, tuple[Claim, ...]] = {}
        """By incarnation."""
        self._doomed: set[str] = set()
        """Volumes to be removed when their container has ended."""
        self.used: dict[str, int] = {}

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
            VolumeError: One belongs to a container that has not ended yet, is too full, or cannot be used;
                or this machine has not the files that count.
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
            self._claims[incarnation_id] = tuple(claims)
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
            self._claims[incarnation_id] = tuple(claims)

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
            self._claims[incarnation_id] = tuple(desired.get(claim.id, claim) for claim in known)

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
        self._claims[holder] = (Claim(id_, "", 0),)
        return holder

    def release(self, incarnation_id: str) -> list[str]:
        """Take the volumes of a container that has ended; return those that are to be deleted now."""
        ended = [claim.id for claim in self._claims.pop(incarnation_id, ()) if claim.id in self._doomed]
        self._doomed.difference_update(ended)
        return [id_ for id_ in ended if self._discard(id_)]

    def prepare(self, incarnation_id: str) -> None:
        """Make the file systems of a container's volumes, or let them grow. Blocks.

        Raises:
            VolumeError: A former container still has one mounted, or the disk is full.
        """
        deadline = time.monotonic() + _SETTLE_S
        for claim in self._claims.get(incarnation_id, ()):
            image = self._image(claim.id)
            if self._place(claim.id).is_dir():
                continue
            if not image.exists():
                images.make(image, claim.size)
                continue
            images.wait_until_unused(image, deadline)
            images.grow(image, claim.size)

    # Files of one placement

    def placement(self, id_: str) -> int:
        """Return the number of the placement that a volume's files belong to; 0 if it is not known."""
        if not self._exists(id_):
            return 0
        try:
            return int(self._marker(id_).read_text())
        except (OSError, ValueError):
            return 0

    def open(self, id_: str) -> int:
        """Open a volume that is held; return a descriptor of its folder, which the caller closes. Blocks.

        Raises:
            VolumeError: It is not there, or cannot be opened.
        """
        if not self._exists(id_):
            raise VolumeError("its files are not on this machine")
        image = self._image(id_)
        try:
            if self._place(id_).is_dir():
                return os.open(self._place(id_), _FOLDER)
            images.wait_until_unused(image, time.monotonic() + _SETTLE_S)
            return open_image(image, self._point(), read_only=True)
        except OSError as error:
            raise VolumeError(f"its files cannot be read: {error}") from error

    def open_running(self, claim: Claim, pid: int) -> int:
        """Open a volume that a running container has; otherwise as :meth:`open`.

        Args:
            claim: The volume.
            pid: A process in the container's namespaces; 0 without namespaces.
        """
        try:
            if self._place(claim.id).is_dir():
                return os.open(self._place(claim.id), _FOLDER)
            return open_inside(pid, claim.path)
        except OSError as error:
            raise VolumeError(f"its files cannot be read: {error}") from error

    def make_scratch(self) -> Path:
        """Make a folder for a copy of a volume. Blocks.

        Raises:
            OSError: It cannot be made.
        """
        path = self._scratch / secrets.token_hex(8)
        path.mkdir(mode=0o700, parents=True)
        return path

    def make_new(self, size: int) -> tuple[Path, int]:
        """Make an empty volume, to be filled and put in place. Blocks.

        Returns:
            The volume, and a descriptor of its folder.

        Raises:
            VolumeError: It cannot be made.
        """
        try:
            if not self._images:
                path = self.make_scratch()
                return path, os.open(path, _FOLDER)
            self._scratch.mkdir(mode=0o700, parents=True, exist_ok=True)
            path = self._scratch / f"{secrets.token_hex(8)}.img"
            images.make(path, size)
            root = open_image(path, self._point(), read_only=False)
            with contextlib.suppress(OSError):
                os.rmdir("lost+found", dir_fd=root)
        except OSError as error:
            raise VolumeError(f"its files cannot be made: {error}") from error
        return path, root

    def replace(self, id_: str, new: Path, placement: int) -> None:
        """Put a filled volume in the place of a former one, which is discarded. Blocks.

        Raises:
            VolumeError: It cannot be put there.
        """
        place = self._image(id_) if new.suffix == ".img" else self._place(id_)
        try:
            if new.suffix == ".img":
                images.wait_until_unused(new, time.monotonic() + _SETTLE_S)
            place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self._exists(id_) and not self._discard(id_):
                raise VolumeError("the former files are in the way")
            new.rename(place)
            self._note_placement(id_, placement)
            sync_folder(place.parent)
        except OSError as error:
            raise VolumeError(f"its files cannot be put in place: {error}") from error

    def clear_scratch(self) -> None:
        """Remove what a killed manager left. Blocks."""
        make_accessible(self._scratch)
        remove(self._scratch)

    def _check_placement(self, id_: str, placement: VolumePlacement) -> None:
        if self._exists(id_) and self.placement(id_) >= placement.number:
            return
        if not placement.is_new:
            raise VolumeError(
                f"the files of volume {placement.name!r} are not on this machine any more; move the "
                "container to the machine that has them, or remove the volume"
            )
        if placement.number:
            try:
                self._note_placement(id_, placement.number)
            except OSError as error:
                raise VolumeError(f"cannot write {error.filename}: {error.strerror}") from error

    def _note_placement(self, id_: str, number: int) -> None:
        marker = self._marker(id_)
        marker.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(marker, str(number).encode())
        sync_folder(marker.parent)

    def _exists(self, id_: str) -> bool:
        return self._place(id_).is_dir() or self._image(id_).exists()

    def _marker(self, id_: str) -> Path:
        return self._placements / self._place(id_).relative_to(self._folder)

    def _point(self) -> Path:
        point = self._scratch / "point"
        point.mkdir(mode=0o700, parents=True, exist_ok=True)
        return point

    # Removal

    def doom(self, id_: str) -> bool:
        """Remove a volume; return whether :meth:`delete_removed` can delete its files now.

        If a container has it, it is removed at :meth:`release`.
        """
        if self._holder(id_) is not None:
            self._doomed.add(id_)
            return False
        return self._discard(id_)

    def delete_removed(self) -> None:
        """Delete the files of volumes that were removed. Blocks; may be repeated."""
        with contextlib.suppress(FileNotFoundError):
            for path in list(self._trash.iterdir()):
                if path.suffix == ".img":
                    path.unlink(missing_ok=True)
                    continue
                make_accessible(path)
                remove(path)

    def _discard(self, id_: str) -> bool:
        """Move a volume out of the way, so that a new one of the same name can be made at once."""
        self.used.pop(id_, None)
        try:
            for path in (self._place(id_), self._image(id_)):
                if path.exists():
                    self._trash.mkdir(mode=0o700, parents=True, exist_ok=True)
                    path.rename(self._trash / f"{secrets.token_hex(8)}{path.suffix}")
            self._marker(id_).unlink(missing_ok=True)
        except OSError as error:
            _log.error("volume %s cannot be removed: %s", id_, error)
            return False
        return True

    # Measuring

    def measure(self, pids: Mapping[str, int]) -> list[tuple[str, str]]:
        """Measure all volumes of running containers, and once those of others. Blocks.

        Args:
            pids: A process in the namespaces of each container, by incarnation; 0 without namespaces.

        Returns:
            The incarnations with a folder that holds more than its size, and what to tell their users.
        """
        over = []
        for incarnation_id, claims in list(self._claims.items()):
            for claim in claims:
                self._measure(claim.id, pids.get(incarnation_id, 0), claim.path)
                if claim.size and self._place(claim.id).is_dir() and self.used.get(claim.id, 0) > claim.size:
                    over.append((incarnation_id, _too_full(claim.id, self.used[claim.id], claim.size)))
        for id_ in self._existing():
            if id_ not in self.used:
                self._measure(id_, 0, "")
        return over

    def _measure(self, id_: str, pid: int, path: str) -> None:
        place, image = self._place(id_), self._image(id_)
        with contextlib.suppress(OSError, VolumeError):  # it was removed, or its container ended just now
            if place.is_dir():
                self.used[id_] = _size_of(place)
            elif pid:
                found = os.statvfs(f"/proc/{pid}/root{path}")
                if found.f_blocks * found.f_frsize <= image.stat().st_size:  # else it is not mounted yet
                    self.used[id_] = (found.f_blocks - found.f_bfree) * found.f_frsize
            elif image.exists() and self._holder(id_) is None:
                self.used[id_] = images.used(image)

    def _existing(self) -> list[str]:
        try:
            users = [user for user in self._folder.iterdir() if is_name(user.name)]
            return sorted({f"{user.name}/{one.stem}" for user in users for one in user.iterdir()})
        except OSError:
            return []

    # Places

    def _check_free(self, id_: str, volume: Volume) -> None:
        if id_ in self._doomed:
            raise VolumeError(f"the former volume {volume.name!r} is still being removed")
        if self._holder(id_) is not None:
            raise VolumeError(f"volume {volume.name!r} belongs to a container that has not ended yet")
        if self._place(id_).is_dir():
            self.used[id_] = _size_of(self._place(id_))
            if self.used[id_] > volume.size:
                raise VolumeError(_too_full(id_, self.used[id_], volume.size))

    def _mount_of(self, id_: str, volume: Volume) -> VolumeMount:
        place, image = self._place(id_), self._image(id_)
        if image.exists() and not self._images:
            raise VolumeError(
                f"volume {volume.name!r} is a file system, and this machine cannot mount it any more; "
                "its operator can start the engine as root"
            )
        try:
            for folder in (self._folder, place.parent):  # mkdir's mode is not for the parents that it makes
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not self._images or place.is_dir():
                place.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise VolumeError(f"cannot make {error.filename}: {error.strerror}") from error
        if place.is_dir():
            return VolumeMount(volume.variable, place, volume.path, image=False)
        return VolumeMount(volume.variable, image, volume.path, image=True)

    def _holder(self, id_: str) -> str | None:
        return next((holder for holder, own in self._claims.items() if any(c.id == id_ for c in own)), None)

    def _place(self, id_: str) -> Path:
        user, _, name = id_.partition("/")
        if not (is_name(user) and is_name(name)):
            raise VolumeError(f"{id_!r} is not the name of a volume")
        return self._folder / user / name

    def _image(self, id_: str) -> Path:
        return self._place(id_).with_suffix(".img")


def _claim_of(id_: str, volume: Volume, placement: VolumePlacement | None) -> Claim:
    number = 0 if placement is None else placement.number
    return Claim(id_, volume.path, volume.size, volume.snapshots, number)


def sync_folder(folder: Path) -> None:
    """Write to the disk which files a folder holds. Blocks."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _too_full(id_: str, used: int, size: int) -> str:
    name = id_.partition("/")[2]
    return (
        f"volume {name!r} holds {about(used)} and may hold {about(size)}; create the container with a larger "
        f"size for it, or remove the volume (rce volume remove {name})"
    )


def _size_of(folder: Path) -> int:
    """Return the bytes on disk of all files below a folder."""
    total, waiting = 0, [os.fspath(folder)]
    while waiting:
        with contextlib.suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    total += entry.stat(follow_symlinks=False).st_blocks * 512
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
    return total
