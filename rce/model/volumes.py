"""Volumes: folders of a user's that outlive the container that writes to them. Pure."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from msgspec import Struct, to_builtins

from rce.model import written
from rce.model.quantities import MEGABYTE, about, read_memory, write_plain_memory

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

MIN_VOLUME = 4 * MEGABYTE
"""Bytes; a smaller file system has no room for its own records."""
MAX_VOLUME = 2**44
MAX_VOLUMES = 16
"""Of one container."""
MIN_SNAPSHOTS = 5
MAX_SNAPSHOTS = 86400
"""Seconds between two snapshots of a volume."""
HOME = "/home/rce"
"""A container's home; volumes may be mounted below it."""

_RESERVED = (  # paths in a container, not on this machine
    *("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/libx32", "/opt/rce", "/opt/ros"),
    *("/proc", "/root", "/run", "/sbin", "/sys", "/tmp", "/usr", "/var/log", "/var/run", "/var/tmp"),  # noqa: S108 - the container's own
)
_PATH = re.compile(r"(/(?!\.\.?(?:/|\Z))[A-Za-z0-9._+@-]+)+")
_MAX_PATH = 255


class Volume(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A volume of a container."""

    name: str
    """Unique among the user's volumes."""
    path: str
    """Where the container sees it; absolute."""
    size: int
    """Bytes."""
    snapshots: int = 0
    """Seconds between two snapshots while its container runs; 0: none."""

    @property
    def variable(self) -> str:
        """The environment variable of nodes that holds the path of the folder."""
        return f"RCE_VOLUME_{self.name.upper()}"


class WrittenVolume(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A volume as users write it."""

    name: written.Name
    path: written.Text
    size: written.Quantity
    snapshots: float = 0


def read_volumes(volumes: Sequence[WrittenVolume]) -> tuple[Volume, ...]:
    """Check the volumes of a container.

    Raises:
        ValueError: One cannot be mounted; the text names it and what is allowed.
    """
    if len(volumes) > MAX_VOLUMES:
        raise ValueError(f"must be at most {MAX_VOLUMES} volumes, not {len(volumes)}")
    found: list[Volume] = []
    for number, one in enumerate(volumes):
        problem = _path_problem(one.path)
        if problem:
            raise ValueError(f"[{number}].path {problem}, not {one.path!r:.60}")
        volume = Volume(
            name=one.name,
            path=one.path,
            size=_read_size(number, one.size),
            snapshots=_read_snapshots(number, one.snapshots),
        )
        _check_pair(number, volume, found)
        found.append(volume)
    return tuple(found)


def write_volumes(volumes: Iterable[Volume]) -> list[dict[str, object]]:
    """Write volumes as users write them; sizes in MB, as plain numbers."""
    return [{**to_builtins(one), "size": write_plain_memory(one.size)} for one in volumes]


def overlap(one: str, other: str) -> bool:
    """Return whether two absolute paths are the same, or one of them is inside the other."""
    return one == other or one.startswith(f"{other.rstrip('/')}/") or other.startswith(f"{one.rstrip('/')}/")


def _path_problem(path: str) -> str:
    if len(path) > _MAX_PATH or not _PATH.fullmatch(path):
        return "must be an absolute path of letters, digits, '.', '_', '-', '+' and '@' without '..'"
    reserved = next((place for place in _RESERVED if overlap(path, place)), "")
    if not reserved and (path == HOME or HOME.startswith(f"{path}/")):
        reserved = HOME
    return f"must not hide {reserved} of the container: use a path such as /data" if reserved else ""


def _read_size(number: int, size: written.Quantity) -> int:
    try:
        read = read_memory(size)
    except ValueError as error:
        raise ValueError(f"[{number}].size {error}") from error
    if not MIN_VOLUME <= read <= MAX_VOLUME:
        least, most = MIN_VOLUME // MEGABYTE, MAX_VOLUME // MEGABYTE
        raise ValueError(f"[{number}].size must be {least} to {most} MB, not {about(read)}")
    return read


def _read_snapshots(number: int, seconds: float) -> int:
    if seconds and not MIN_SNAPSHOTS <= seconds <= MAX_SNAPSHOTS:
        raise ValueError(
            f"[{number}].snapshots must be {MIN_SNAPSHOTS} to {MAX_SNAPSHOTS} seconds, or 0 for none, "
            f"not {seconds:g}"
        )
    return int(seconds)


def _check_pair(number: int, volume: Volume, others: Iterable[Volume]) -> None:
    for other in others:
        if other.name == volume.name:
            raise ValueError(f"[{number}].name {volume.name!r} is mounted already, at {other.path}")
        if overlap(other.path, volume.path):
            raise ValueError(f"[{number}].path {volume.path} and {other.path} are inside one another")
        if other.variable == volume.variable:
            raise ValueError(f"[{number}].name {volume.name!r} differs from {other.name!r} only in its case")
