"""The capacity and the promises of machines, from the tables; and the limits of one user's requests."""

from __future__ import annotations

import ipaddress
from collections import Counter
from typing import TYPE_CHECKING

from rce.control import TaskSetKind
from rce.model import DEFAULT_PREFIX, MEGABYTE, MIN_MEMORY, Network, Resources
from rce_master.exceptions import ConflictError, ForbiddenError, InvalidRequestError
from rce_master.state import limits, volumes
from rce_master.state.placement import Room
from rce_master.state.records import Container, TaskSet, UserRole, tombstone_key

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.tables import Tables


def is_draining(tables: Tables, task_set: TaskSet) -> bool:
    """Whether a machine is being drained."""
    return task_set.machine.draining or task_set.process in tables.drains


def room_at(tables: Tables, task_set: TaskSet) -> Room:
    """Sum up the promises of a machine: to its containers and to those that move there."""
    placed = [e for e in tables.endpoints.by("task_set", task_set.process) if isinstance(e, Container)]
    coming = [tables.container(move.id) for move in tables.moves.by("to", task_set.process)]
    room = Room(
        process=task_set.process,
        machine=task_set.machine,
        alias=_alias(tables, task_set),
        draining=is_draining(tables, task_set),
    )
    return room.filled(container.resources for container in (*placed, *coming) if container is not None)


def _alias(tables: Tables, task_set: TaskSet) -> str:
    """Return a name that distinguishes task sets on the same machine."""
    namesakes = sum(
        s.machine.name == task_set.machine.name and s.kind is TaskSetKind.CONTAINER for s in tables.task_sets
    )
    return task_set.process if namesakes > 1 else ""


def rooms(tables: Tables, *, away: bool = False) -> dict[str, Room]:
    """Return all connected container machines, or also those that may still come back, by process."""
    return {
        task_set.process: room_at(tables, task_set)
        for task_set in tables.task_sets
        if task_set.kind is TaskSetKind.CONTAINER and (away or tables.is_connected(task_set.process))
    }


def group_mates(tables: Tables, container: Container) -> list[Container]:
    """Return the other containers that must be on the same machine: those of its group's network."""
    requested = container.resources
    if requested.network is not Network.GROUP:
        return []
    return [
        other
        for other in tables.containers(container.user)
        if other.id != container.id
        and (other.resources.network, other.resources.group) == (Network.GROUP, requested.group)
    ]


def open_to(tables: Tables, container: Container, found: dict[str, Room]) -> list[Room]:
    """Return the machines where a container may be: with its group, and not where it is still ending."""
    tied = {mate.task_set for mate in group_mates(tables, container) if mate.task_set}
    return [
        room
        for room in found.values()
        if (not tied or room.process in tied)
        and tombstone_key(room.process, container.id) not in tables.tombstones
        and volumes.admits(tables, container, room.process)
    ]


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
    group = container.resources.group
    if group:
        found.update(
            other.task_set
            for other in tables.containers(container.user)
            if other.id != container.id and other.resources.group == group
        )
    return found


def _processes_near(tables: Tables, process: str) -> list[str]:
    task_set = tables.task_sets.get(process)
    if task_set is None or task_set.kind is TaskSetKind.CONTAINER:
        return [process]
    return [
        other.process
        for other in tables.task_sets
        if other.kind is TaskSetKind.CONTAINER and other.machine.name == task_set.machine.name
    ]


def own(tables: Tables, container: Container) -> Counter[str]:
    """Count, by process, the other containers of a container's user."""
    return Counter(c.task_set for c in tables.containers(container.user) if c.id != container.id)


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
    others = [c for c in tx.tables.containers(user) if c.id != id_]
    _check_group(requested, others)
    if tx.tables.users[user].role is not UserRole.ADMIN:
        _check_privileges(requested)
    limits.check_all_resources(tx, user, [requested, *(c.resources for c in others)])


def _check_privileges(requested: Resources) -> None:
    if requested.network is Network.HOST:
        raise ForbiddenError("network: host is for containers of administrators; use none or group")
    if requested.image.startswith("/"):
        raise ForbiddenError("image: folders of the machine are for administrators; use an OCI image's name")


def _check_group(requested: Resources, others: list[Container]) -> None:
    if requested.network is not Network.GROUP or not requested.group_ip:
        return
    address = _address(requested.group_ip)
    for other in others:
        theirs = other.resources
        if (theirs.network, theirs.group) != (Network.GROUP, requested.group) or not theirs.group_ip:
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
