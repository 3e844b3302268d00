"""Where a container may be and where it belongs, from the tables; and the limits of one user's requests."""

from __future__ import annotations

import ipaddress
from collections import Counter
from typing import TYPE_CHECKING

from rce.control import TaskSetKind
from rce.model import DEFAULT_PREFIX, MEGABYTE, MIN_MEMORY, Network, Resources
from rce_master.exceptions import ConflictError, ForbiddenError, InvalidRequestError
from rce_master.state import limits, volumes
from rce_master.state.placement import Room
from rce_master.state.records import Container, TaskSet, tombstone_key
from rce_master.state.user_records import UserRole
from rce_master.state.waiting import group_key

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rce_master.state.changes import Transaction
    from rce_master.state.tables import Tables


def room_at(tables: Tables, task_set: TaskSet) -> Room:
    """Return the room of a machine; that of a robot task set's has no promises."""
    room = tables.rooms.get(task_set.process)
    return room or Room(
        process=task_set.process, machine=task_set.machine, draining=task_set.machine.draining
    )


def group_mates(tables: Tables, container: Container) -> list[Container]:
    """Return the other containers that must be on the same machine: those of its group's network."""
    if container.resources.network is not Network.GROUP:
        return []
    return [other for other in _of_group(tables, container) if other.resources.network is Network.GROUP]


def _of_group(tables: Tables, container: Container) -> list[Container]:
    """Return the other containers of a container's group, in its network or not."""
    key = group_key(container)
    found = tables.endpoints.by("group", key) if key else []
    return [other for other in found if isinstance(other, Container) and other.id != container.id]


def is_tied_elsewhere(tables: Tables, container: Container, process: str) -> bool:
    """Whether the others of a container's group network are on another machine."""
    return any(mate.task_set not in ("", process) for mate in group_mates(tables, container))


def tied_to(tables: Tables, container: Container) -> Collection[str] | None:
    """Return the processes of the only machines where a container may be; None: it may be on any.

    It is bound to the machines of its group's network and to that of its volumes.
    """
    mates = {mate.task_set for mate in group_mates(tables, container) if mate.task_set}
    place = volumes.tied_to(tables, container)
    if place:
        return mates & {place} if mates else {place}
    return mates or None


def admission(tables: Tables, container: Container, *, moves: bool = False) -> Callable[[str], bool]:
    """Return what tells of a process whether its machine may have a container, whatever its room is.

    It may not where the container, or one of the same name before it, or its volume, is still ending.

    Args:
        tables: The tables.
        container: The container.
        moves: Whether its volumes may be moved there.
    """
    has_volumes = bool(container.resources.volumes)

    def admits(process: str) -> bool:
        if tombstone_key(process, container.id) in tables.tombstones:
            return False
        return not has_volumes or volumes.admits(tables, container, process, moves=moves)

    return admits


def company(tables: Tables, container: Container) -> Counter[str]:
    """Count, by process, the related endpoints of a container: its peers, and others of its group.

    A robot counts for the container machines on the same machine as its task set.
    """
    found: Counter[str] = Counter()
    for link in tables.links.by("endpoint", container.id):
        if link.a == link.b:
            continue
        peer = tables.endpoints[link.peer(container.id)]
        found.update(_processes_near(tables, peer.task_set))
    if container.resources.group:
        found.update(other.task_set for other in _of_group(tables, container))
    return found


def _processes_near(tables: Tables, process: str) -> list[str]:
    task_set = tables.task_sets.get(process)
    if task_set is None or task_set.kind is TaskSetKind.CONTAINER:
        return [process]
    return [other.process for other in tables.task_sets.by("machine", task_set.machine.name)]


# Limits of users' requests


def check_resources(tx: Transaction, user: str, id_: str, requested: Resources) -> None:
    """Check that a user may request these resources.

    Args:
        tx: The transaction.
        user: The container's user.
        id_: The container; its former promise does not count.
        requested: The requested resources.

    Raises:
        Refused: The request exceeds a limit; the text says why and how to fix it.
    """
    if 0 < requested.memory < MIN_MEMORY:
        raise InvalidRequestError(
            f"memory: {requested.memory / MEGABYTE:.3g} MB are too little; a container itself needs "
            f"{MIN_MEMORY // MEGABYTE} MB (a plain number is MB)"
        )
    _check_group(tx.tables, Container(id=id_, resources=requested))
    if tx.tables.users[user].role is not UserRole.ADMIN:
        _check_privileges(requested)
    known = tx.tables.container(id_)
    before, total = tx.tables.requested.sum_of(user), tx.tables.requested.sum_of(user)
    if known is not None:
        total.add(known.resources, -1)
    total.add(requested)
    limits.check_all_resources(tx, user, before, total)


def _check_privileges(requested: Resources) -> None:
    if requested.network is Network.HOST:
        raise ForbiddenError("network: host is for containers of administrators; use none or group")
    if requested.image.startswith("/"):
        raise ForbiddenError("image: folders of the machine are for administrators; use an OCI image's name")


def _check_group(tables: Tables, container: Container) -> None:
    requested = container.resources
    if requested.network is not Network.GROUP or not requested.group_ip:
        return
    address = _address(requested.group_ip)
    for other in group_mates(tables, container):
        theirs = other.resources
        if not theirs.group_ip:
            continue
        there = _address(theirs.group_ip)
        if there.ip == address.ip:
            raise ConflictError(
                f"groupIp: {address.ip} is the address of container {other.tag!r} of the group "
                f"{requested.group!r}"
            )
        if there.network != address.network:
            raise ConflictError(
                f"groupIp: {address} is not in {there.network}, where container {other.tag!r} of the group "
                f"{requested.group!r} is; give all of them addresses of one network"
            )


def _address(text: str) -> ipaddress.IPv4Interface:
    return ipaddress.IPv4Interface(text if "/" in text else f"{text}/{DEFAULT_PREFIX}")
