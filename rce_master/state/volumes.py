"""Volumes: folders of users on container machines, which outlive the containers that write to them.

A volume is reserved with the first container that asks for it. It is on the machine where that container is
placed, and stays there: containers with it are placed only there, and are not handed over. One container has
it at a time. It is removed when its user asks for that; the machine then removes the folder, at once or when
it comes back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.model import MEGABYTE, Resources
from rce_master.exceptions import ConflictError, LimitReachedError, NotFoundError
from rce_master.state import limits
from rce_master.state.records import Container, UserVolume, VolumeRemoval, user_volume_key, volume_removal_key

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import RemoveVolume, VolumeRemoved
    from rce_master.state.tables import Tables


def check(tx: Transaction, user: str, id_: str, requested: Resources) -> None:
    """Check that a new container may have the volumes that it asks for.

    Raises:
        ConflictError: Another container has one, or it exists with more room, or they are on two machines.
        LimitReachedError: The user may not have that much.
    """
    more = 0
    places: dict[str, str] = {}
    for volume in requested.volumes:
        holder = holder_of(tx.tables, user, volume.name)
        if holder is not None and holder.id != id_:
            raise ConflictError(
                f"volume {volume.name!r} belongs to container {holder.tag!r}: one container at a time "
                "writes to a volume; destroy that container first, or use another volume"
            )
        there = tx.tables.volumes.get(user_volume_key(user, volume.name))
        if there is not None and there.size > volume.size:
            raise ConflictError(
                f"volume {volume.name!r} has {_megabytes(there.size)} and cannot shrink to "
                f"{_megabytes(volume.size)}; ask for at least {_megabytes(there.size)}, or remove it first "
                f"(rce volume remove {volume.name})"
            )
        if there is not None and there.process:
            places[there.process] = volume.name
        more += volume.size - (there.size if there is not None else 0)
    if len(places) > 1:
        names = " and ".join(map(repr, places.values()))
        raise ConflictError(f"volumes {names} are on different machines; a container can have one of them")
    if more:
        _check_disk(tx, user, more)


def _check_disk(tx: Transaction, user: str, more: int) -> None:
    limit = limits.limit_of(tx.tables, tx.settings, user, "disk")
    used = limits.used_of(tx.tables, user)["disk"] + more
    if limit.most and used > limit.most:
        raise LimitReachedError(
            f"your packages and volumes would take {_megabytes(used)} of disk, and you may have "
            f"{_megabytes(limit.most)}; remove a volume (rce volume remove) or a package, or have an "
            f"administrator allow more: rce user limit {user} --disk"
        )


def reserve(tx: Transaction, container: Container) -> None:
    """Note the volumes of a new container; those that exist grow to its size."""
    for volume in container.resources.volumes:
        there = tx.tables.volumes.get(user_volume_key(container.user, volume.name))
        known = there or UserVolume(user=container.user, name=volume.name, size=volume.size)
        tx.put(replace(known, size=volume.size))
        if there is None:
            tx.happen("volume_requested", known.id, _megabytes(volume.size))


def bind(tx: Transaction, container: Container, process: str) -> None:
    """Note that the volumes of a container are on its machine."""
    for volume in container.resources.volumes:
        known = tx.tables.volumes[user_volume_key(container.user, volume.name)]
        tx.put(replace(known, process=process))


def release(tx: Transaction, container: Container) -> None:
    """Forget the volumes of a removed container that never reached a machine."""
    for volume in container.resources.volumes:
        known = tx.tables.volumes.get(user_volume_key(container.user, volume.name))
        if known is not None and not known.process:
            tx.delete(tx.tables.volumes, known.id)


def remove(tx: Transaction, command: RemoveVolume) -> None:
    """Remove a volume with its files.

    Raises:
        NotFoundError: It does not exist.
        ConflictError: A container has it.
    """
    known = tx.tables.volumes.get(user_volume_key(command.user, command.name))
    if known is None:
        raise NotFoundError(f"there is no volume {command.name!r}; rce volume list lists them")
    holder = holder_of(tx.tables, command.user, command.name)
    if holder is not None:
        raise ConflictError(
            f"volume {command.name!r} belongs to container {holder.tag!r}; destroy that container first"
        )
    _remove(tx, known)


def forget_user(tx: Transaction, user: str) -> None:
    """Remove all volumes of a user who is removed; their containers are gone already."""
    for known in tx.tables.volumes.by("user", user):
        _remove(tx, known)


def _remove(tx: Transaction, known: UserVolume) -> None:
    tx.delete(tx.tables.volumes, known.id)
    if known.process:
        removal = VolumeRemoval(process=known.process, volume=known.id)
        tx.put(removal)
        tx.changes.volume_removals.append(removal)
    tx.happen("volume_removed", known.id)


def removed(tx: Transaction, command: VolumeRemoved) -> None:
    """Note that a machine has removed a volume's files."""
    key = volume_removal_key(command.process, command.volume)
    tx.delete(tx.tables.volume_removals, key)


def holder_of(tables: Tables, user: str, name: str) -> Container | None:
    """Return the container that has a volume; None if none has."""
    found = tables.endpoints.by("volume", user_volume_key(user, name))
    return next((one for one in found if isinstance(one, Container)), None)


def tied_to(tables: Tables, container: Container) -> str:
    """Return the process of the machine where a container's volumes are; empty if it can be anywhere."""
    return next((known.process for known in _known(tables, container) if known.process), "")


def admits(tables: Tables, container: Container, process: str) -> bool:
    """Whether a machine may have a container, as far as its volumes are concerned."""
    volumes = container.resources.volumes
    if not volumes:
        return True
    ending = any(
        volume_removal_key(process, user_volume_key(container.user, volume.name)) in tables.volume_removals
        for volume in volumes
    )
    return not ending and tied_to(tables, container) in ("", process)


def why_tied(tables: Tables, container: Container, process: str) -> str:
    """Say why a container's volumes keep it away from a machine; empty if they do not."""
    if admits(tables, container, process):
        return ""
    known = next((known for known in _known(tables, container) if known.process not in ("", process)), None)
    return f"has not its volume {known.name!r}" if known is not None else "still removes its former volume"


def _known(tables: Tables, container: Container) -> list[UserVolume]:
    keys = (user_volume_key(container.user, volume.name) for volume in container.resources.volumes)
    return [known for key in keys if (known := tables.volumes.get(key)) is not None]


def _megabytes(count: float) -> str:
    return f"{count / MEGABYTE:.0f} MB"
