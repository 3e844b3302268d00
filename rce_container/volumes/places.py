"""Where the volumes of a machine are, and which placement their files belong to.

``STATE/volumes/USER/NAME.img``, or a folder ``NAME`` where images do not work. Beside them,
``.placements/USER/NAME`` holds the number of the placement, and of restored files the snapshot; ``.removed``
what is to be deleted, ``.scratch`` what is being made.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import time
from pathlib import Path

from rce.model import is_name
from rce_container.descent import FOLDER
from rce_container.exceptions import VolumeError
from rce_container.files import remove, sync_folder, write_whole
from rce_container.folder import make_accessible
from rce_container.volumes import images
from rce_container.volumes.mounted import open_image, open_inside

_log = logging.getLogger(__name__)

SETTLE_S = 10.0
"""Seconds that a former container's mount may take to end."""


class VolumePlaces:
    """The files of volumes. Volumes are named ``user/name``.

    Args:
        folder: Holds them.
        images: Whether new volumes are images; else they are folders.
    """

    def __init__(self, folder: Path, *, images: bool) -> None:
        self._folder = folder
        self._trash = folder / ".removed"
        self._scratch = folder / ".scratch"
        self._placements = folder / ".placements"
        self._images = images

    def folder(self, id_: str) -> Path:
        """Return where a volume is, or would be, if it is a folder.

        Raises:
            VolumeError: That is no name of a volume.
        """
        user, _, name = id_.partition("/")
        if not (is_name(user) and is_name(name)):
            raise VolumeError(f"{id_!r} is not the name of a volume")
        return self._folder / user / name

    def image(self, id_: str) -> Path:
        """Return where a volume is, or would be, if it is an image."""
        return self.folder(id_).with_suffix(".img")

    def make_folder(self, path: Path) -> None:
        """Make a folder of volumes, with those above it, for the owner only. Quick.

        Raises:
            OSError: It cannot be made.
        """
        self._folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        parts = path.relative_to(self._folder).parts
        for count in range(len(parts) + 1):  # mkdir's mode is not for the parents that it makes
            self._folder.joinpath(*parts[:count]).mkdir(mode=0o700, exist_ok=True)

    def existing(self) -> list[str]:
        """Return all volumes, without other files beside them, such as copies that an operator made."""
        found = set[str]()
        for user in _paths_in(self._folder):
            if is_name(user.name):
                names = (path.name.removesuffix(".img") for path in _paths_in(user))
                found.update(f"{user.name}/{name}" for name in names if is_name(name))
        return sorted(found)

    # One placement

    def placement(self, id_: str) -> int:
        """Return the number of the placement of a volume's files; 0 if it is not known."""
        return self._noted(id_)[0]

    def is_restored(self, id_: str, number: int, snapshot: str) -> bool:
        """Whether a volume's files were made of this snapshot for this placement.

        The number alone does not say so: a master whose state was restored from a backup counts from an
        earlier one, and machines may hold files of what it does not know.
        """
        return self._noted(id_) == (number, snapshot)

    def _noted(self, id_: str) -> tuple[int, str]:
        """Return the number of the placement of a volume's files, and the snapshot that they were made of."""
        if not self.exists(id_):
            return 0, ""
        try:
            number, _, snapshot = self._marker(id_).read_text().partition(" ")
            return int(number), snapshot
        except (OSError, ValueError):
            return 0, ""

    def open(self, id_: str) -> int:
        """Open a volume that no container has. Blocks.

        Returns:
            A descriptor of its folder, which the caller closes.

        Raises:
            VolumeError: It is not there, or cannot be opened.
        """
        if not self.exists(id_):
            raise VolumeError("its files are not on this machine")
        image = self.image(id_)
        try:
            if self.folder(id_).is_dir():
                return os.open(self.folder(id_), FOLDER)
            images.wait_until_unused(image, time.monotonic() + SETTLE_S)
            return open_image(image, self._point(), read_only=True)
        except OSError as error:
            raise VolumeError(f"its files cannot be read: {error}") from error

    def open_running(self, id_: str, pid: int, path: str) -> int:
        """Open a volume that a running container has; otherwise as :meth:`open`.

        Args:
            id_: The volume.
            pid: A process in the container's namespaces; 0 without namespaces.
            path: Where the container sees it.
        """
        try:
            if self.folder(id_).is_dir():
                return os.open(self.folder(id_), FOLDER)
            root = open_inside(pid, path)
        except OSError as error:
            raise VolumeError(f"its files cannot be read: {error}") from error
        if not images.is_on(self.image(id_), os.fstat(root).st_dev):  # the empty folder below the mount
            os.close(root)
            raise VolumeError("its file system is not mounted in its container")
        return root

    def make_scratch(self) -> Path:
        """Make a folder for a copy of a volume. Blocks.

        Raises:
            OSError: It cannot be made.
        """
        path = self._scratch / secrets.token_hex(8)
        self.make_folder(path)
        return path

    def make_new(self, size: int) -> tuple[Path, int]:
        """Make an empty volume, to be filled and put in place. Blocks.

        Returns:
            The volume, and a descriptor of its folder.

        Raises:
            VolumeError: It cannot be made; nothing is left of it.
        """
        try:
            if not self._images:
                path = self.make_scratch()
                return path, os.open(path, FOLDER)
            self.make_folder(self._scratch)
            path = self._scratch / f"{secrets.token_hex(8)}.img"
            return path, self._make_image(path, size)
        except OSError as error:
            raise VolumeError(f"its files cannot be made: {error}") from error

    def _make_image(self, path: Path, size: int) -> int:
        try:
            images.make(path, size)
            root = open_image(path, self._point(), read_only=False)
        except BaseException:  # the image takes its whole size from the disk
            path.unlink(missing_ok=True)
            raise
        with contextlib.suppress(OSError):
            os.rmdir("lost+found", dir_fd=root)
        return root

    def replace(self, id_: str, new: Path, placement: int, snapshot: str) -> None:
        """Put a volume that was made of a snapshot in the place of a former one, which is discarded. Blocks.

        Raises:
            VolumeError: It cannot be put there.
        """
        place = self.image(id_) if new.suffix == ".img" else self.folder(id_)
        try:
            if new.suffix == ".img":
                images.wait_until_unused(new, time.monotonic() + SETTLE_S)
            self.make_folder(place.parent)
            if self.exists(id_) and not self.discard(id_):
                raise VolumeError("the former files are in the way")
            new.rename(place)
            self.note_placement(id_, placement, snapshot)
            sync_folder(place.parent)
        except OSError as error:
            raise VolumeError(f"its files cannot be put in place: {error}") from error

    def clear_scratch(self) -> None:
        """Remove what a killed manager left. Blocks."""
        make_accessible(self._scratch)
        remove(self._scratch)

    def note_placement(self, id_: str, number: int, snapshot: str = "") -> None:
        """Note which placement a volume's files belong to, so that it survives a loss of power. Blocks.

        Args:
            id_: The volume.
            number: Of the placement.
            snapshot: What they were made of; empty: they began without files.

        Raises:
            OSError: It cannot be written.
        """
        marker = self._marker(id_)
        self.make_folder(marker.parent)
        write_whole(marker, f"{number} {snapshot}".strip().encode(), durable=True)

    def exists(self, id_: str) -> bool:
        """Whether a volume has files here."""
        return self.folder(id_).is_dir() or self.image(id_).exists()

    def _marker(self, id_: str) -> Path:
        return self._placements / self.folder(id_).relative_to(self._folder)

    def _point(self) -> Path:
        point = self._scratch / "point"
        self.make_folder(point)
        return point

    # Removal

    def discard(self, id_: str) -> bool:
        """Move a volume out of the way of a new one of the same name; return whether that worked."""
        try:
            for path in (self.folder(id_), self.image(id_)):
                if path.exists():
                    self.make_folder(self._trash)
                    path.rename(self._trash / f"{secrets.token_hex(8)}{path.suffix}")
            self._marker(id_).unlink(missing_ok=True)
        except OSError as error:
            _log.error("volume %s cannot be removed: %s", id_, error)
            return False
        return True

    def delete_removed(self) -> None:
        """Delete the files of volumes that were removed. Blocks; may be repeated."""
        with contextlib.suppress(FileNotFoundError):
            for path in list(self._trash.iterdir()):
                if path.suffix == ".img":
                    path.unlink(missing_ok=True)
                    continue
                make_accessible(path)
                remove(path)


def _paths_in(folder: Path) -> list[Path]:
    """List a folder; what is not a folder, or was removed meanwhile, counts as empty."""
    try:
        return list(folder.iterdir())
    except OSError:
        return []
