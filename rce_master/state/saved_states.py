"""Saved states of nodes: the newest snapshot of each, which its node gets when it starts again anywhere.

A snapshot is accepted only of the incarnation that is the container now, and only if it is newer than the one
before. So they have one order, whatever machines, masters and connections they came by. A node's snapshot is
removed on request, or with its container; a node that is removed and added again continues from it.

The contents are kept elsewhere, under their hash; this module keeps their records.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.model import MAX_STATE, MEGABYTE, about
from rce_master.exceptions import ConflictError, InvalidRequestError, LimitReachedError, NotFoundError
from rce_master.state import limits
from rce_master.state.records import Container
from rce_master.state.volume_records import saved_state_key

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import RemoveState, SaveState
    from rce_master.state.settings import StateSettings
    from rce_master.state.tables import Tables
    from rce_master.state.volume_records import SavedState


def save(tx: Transaction, command: SaveState) -> None:
    """Put a snapshot in place of the one before."""
    check(tx.tables, tx.settings, command.state)
    tx.put(command.state)


def check(tables: Tables, settings: StateSettings, state: SavedState) -> None:
    """Check that a snapshot may be kept.

    Raises:
        NotFoundError: There is no such container, or no node of it whose state is kept.
        ConflictError: Another incarnation of the container counts now, or a newer snapshot is there.
        InvalidRequestError: It is too large.
        LimitReachedError: Its user may not have that much.
    """
    container = _container(tables, state.container)
    node = container.nodes.get(state.node)
    if node is None or node.state_services is None:
        raise NotFoundError(f"container {container.tag!r} has no node {state.node!r} whose state is kept")
    status = tables.container_live(container.id).status
    if container.task_set != state.process or status is None or status.incarnation != state.incarnation:
        raise ConflictError(f"container {container.tag!r} is somewhere else now, or not known to be there")
    before = tables.saved_states.get(state.id)
    if before is not None and before.incarnation == state.incarnation and before.number >= state.number:
        raise ConflictError("a newer snapshot is there already")
    if state.size > MAX_STATE:
        raise InvalidRequestError(f"it is larger than {MAX_STATE // MEGABYTE} MB, which is the most")
    _check_disk(tables, settings, container.user, state.size - (before.size if before is not None else 0))


def find(tables: Tables, process: str, container: str, node: str) -> SavedState | None:
    """Return the newest snapshot of a node, for the task set that has its container or gets it.

    Raises:
        NotFoundError: There is no such container.
        ConflictError: It is at another task set.
    """
    found = _container(tables, container)
    if not (found.task_set == process or is_moving_to(tables, container, process)):
        raise ConflictError(f"container {found.tag!r} is at another machine")
    return tables.saved_states.get(saved_state_key(container, node))


def is_moving_to(tables: Tables, container: str, process: str) -> bool:
    """Whether a task set makes the copy of a container that is handed over to it."""
    move = tables.moves.get(container)
    return move is not None and move.to == process


def remove(tx: Transaction, command: RemoveState) -> None:
    """Remove the snapshot of a node on request."""
    key = saved_state_key(f"{command.user}/{command.container}", command.node)
    if key not in tx.tables.saved_states:
        raise NotFoundError(
            f"there is no saved state of node {command.node!r} of container {command.container!r}; "
            "rce state list lists them"
        )
    tx.delete(tx.tables.saved_states, key)
    tx.happen("state_removed", key)


def forget(tx: Transaction, container: str) -> None:
    """Remove the snapshots of a container that is removed."""
    for state in tx.tables.saved_states.by("container", container):
        tx.delete(tx.tables.saved_states, state.id)


def _container(tables: Tables, id_: str) -> Container:
    container = tables.container(id_)
    if container is None:
        raise NotFoundError(f"there is no container {id_!r}")
    return container


def _check_disk(tables: Tables, settings: StateSettings, user: str, more: int) -> None:
    limit = limits.limit_of(tables, settings, user, "disk")
    used = limits.used_of(tables, user)["disk"] + more
    if more > 0 and limit.most and used > limit.most:
        raise LimitReachedError(
            f"your packages, volumes and saved states would take {about(int(used))} of disk, and you may"
            f" have {about(int(limit.most))}; remove some, or have an administrator allow more: "
            f"rce user limit {user} --disk"
        )
