"""The place of this process in the machine's cgroups, from ``/proc/self``.

A kernel has one hierarchy of version 2, and any number of version 1, each with controllers of its own.
They may be mounted anywhere, several times, or in part: a container sees its own subtree only.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc/self")

_OCTAL = re.compile(r"\\([0-7]{3})")


class Hierarchy(NamedTuple):
    """One mounted hierarchy, and this process's place in it."""

    version: int
    controllers: frozenset[str]
    """Version 1 only; for version 2 see the file ``cgroup.controllers``."""
    mount: Path
    folder: Path
    """This process's cgroup; the mount point itself or below it."""


class Mount(NamedTuple):
    """A mounted file system of cgroups."""

    version: int
    root: str
    """The mounted part of the hierarchy."""
    point: Path
    options: frozenset[str]


class Membership(NamedTuple):
    """A line of ``/proc/PID/cgroup``."""

    controllers: frozenset[str]
    """Empty for version 2, and for hierarchies without controllers."""
    version: int
    path: str
    """From the root of this process's cgroup namespace."""


def find(proc: Path = PROC) -> list[Hierarchy]:
    """Find all hierarchies with controllers, or of version 2, in which this process can find its cgroup.

    Args:
        proc: A folder with the files ``cgroup`` and ``mountinfo``.
    """
    try:
        memberships = parse_memberships((proc / "cgroup").read_text())
        mounts = parse_mounts((proc / "mountinfo").read_text())
    except OSError:
        return []
    places = (_place(membership, mounts) for membership in memberships)
    return [place for place in places if place is not None]


def parse_memberships(text: str) -> list[Membership]:
    """Read ``/proc/PID/cgroup``; named hierarchies, which have no controllers, are left out."""
    found = []
    for line in text.splitlines():
        number, names, path = line.split(":", 2)
        controllers = frozenset(name for name in names.split(",") if name and "=" not in name)
        if number == "0" and not names:
            found.append(Membership(frozenset(), 2, path))
        elif controllers:
            found.append(Membership(controllers, 1, path))
    return found


def parse_mounts(text: str) -> list[Mount]:
    """Read the cgroup mounts of ``/proc/PID/mountinfo``."""
    found = []
    for line in text.splitlines():
        left, _, right = line.partition(" - ")
        kind, _, options = right.split(" ", 2)
        if kind not in ("cgroup", "cgroup2"):
            continue
        root, point = map(_unescape, left.split(" ")[3:5])
        found.append(Mount(2 if kind == "cgroup2" else 1, root, Path(point), frozenset(options.split(","))))
    return found


def _place(membership: Membership, mounts: Iterable[Mount]) -> Hierarchy | None:
    for mount in mounts:
        if mount.version != membership.version or not membership.controllers <= mount.options:
            continue
        below = _below(membership.path, mount.root)
        if below is not None and os.path.isdir(folder := mount.point / below):  # noqa: PTH112
            return Hierarchy(membership.version, membership.controllers, mount.point, folder)
    return None


def _below(path: str, root: str) -> str | None:
    """Return the path relative to the mounted part; None if it is outside of it."""
    if "/.." in root or "/.." in path:  # outside of this process's cgroup namespace
        return None
    if root == "/":
        return path.lstrip("/")
    if path == root or path.startswith(root + "/"):
        return path[len(root) :].lstrip("/")
    return None


def _unescape(word: str) -> str:
    return _OCTAL.sub(lambda found: chr(int(found[1], 8)), word)
