"""Containers: requests of users, placement, and reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import EndpointState, EndpointStatus, LinkAddress, NodeState, NodeStatus
from rce.model import NodeSpec, ParameterValue, find_circle, read_parameter_value
from rce_master.exceptions import ConflictError, InvalidRequestError, LimitReachedError, NotFoundError
from rce_master.state import (
    activity,
    capacity,
    draining,
    endpoints,
    limits,
    packages,
    placing,
    volume_moves,
    volumes,
)
from rce_master.state.lifecycle import ContainerEvent, ContainerPhase
from rce_master.state.records import Container, ContainerLive

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import (
        AddNode,
        CreateContainer,
        DeleteParameter,
        DestroyContainer,
        RemoveNode,
        SetParameter,
    )

_EVENTS = {
    EndpointState.STARTING: ContainerEvent.STARTING,
    EndpointState.RUNNING: ContainerEvent.RUNNING,
    EndpointState.DEGRADED: ContainerEvent.DEGRADED,
    EndpointState.ABSENT: ContainerEvent.STARTING,
    EndpointState.STOPPING: ContainerEvent.STOPPING,
    EndpointState.FAILED: ContainerEvent.FAILED,
}


_UP = (EndpointState.RUNNING, EndpointState.DEGRADED)

# Requests of users


def create_container(tx: Transaction, command: CreateContainer) -> None:
    """Make a container; an identical one is accepted silently."""
    id_ = f"{command.user}/{command.tag}"
    there = tx.tables.endpoints.get(id_)
    if isinstance(there, Container):
        if command.resources not in (there.resources, there.made):
            raise ConflictError(
                f"container {command.tag!r} exists with other settings; resize or destroy it first"
            )
        return
    if there is not None:
        raise ConflictError(f"{command.tag!r} is a robot already; a container needs another tag")
    limits.check_containers(tx, command.user)
    capacity.check_resources(tx, command.user, id_, command.resources)
    volumes.check(tx, command.user, id_, command.resources)
    made = Container(
        id=id_,
        resources=command.resources,
        number=tx.next_number("container"),
        born=tx.next_number("revision"),
    )
    tx.put(replace(made, size=endpoints.grown(tx, made, command.resources)))
    tx.put(ContainerLive(id=id_, phase=ContainerPhase.REQUESTED, since=tx.now))
    volumes.reserve(tx, made)
    tx.touch(id_)
    tx.happen("container_requested", id_)
    placing.admit(tx, made, wait=command.wait)


def destroy_container(tx: Transaction, command: DestroyContainer) -> None:
    """Remove a container with its parts and connections."""
    container = find(tx, command.user, command.tag)
    endpoints.remove(tx, container.id, "destroyed by its user")
    tx.happen("container_destroyed", container.id)


def add_node(tx: Transaction, command: AddNode) -> None:
    """Add a node; an identical one is accepted silently."""
    container = find(tx, command.user, command.container)
    node = command.node
    there = container.nodes.get(node.tag)
    if there == node:
        return
    if there is not None:
        raise ConflictError(
            f"node {node.tag!r} of container {container.tag!r} exists with other settings; remove it first"
        )
    packages.check_node(tx.tables, command.user, node)
    _check_order(container, node)
    if len(container.nodes) >= tx.settings.max_nodes:
        raise LimitReachedError(f"container {container.tag!r} has {tx.settings.max_nodes} nodes already")
    size = endpoints.grown(tx, container, node)
    tx.put(replace(container, nodes={**container.nodes, node.tag: node}, size=size))
    tx.touch(container.id)


def _check_order(container: Container, node: NodeSpec) -> None:
    """Refuse nodes that would wait for one another; a predecessor may be added later."""
    after = {other.tag: other.after for other in (*container.nodes.values(), node)}
    circle = find_circle(node.tag, after)
    if circle:
        raise InvalidRequestError(
            f"node {node.tag!r}: after goes round in a circle: {' after '.join(circle)}"
        )


def remove_node(tx: Transaction, command: RemoveNode) -> None:
    """Remove a node."""
    container = find(tx, command.user, command.container)
    if command.tag not in container.nodes:
        raise NotFoundError(f"container {container.tag!r} has no node {command.tag!r}")
    kept = {t: n for t, n in container.nodes.items() if t != command.tag}
    size = container.size - endpoints.size_of(container.nodes[command.tag])
    tx.put(replace(container, nodes=kept, size=size))
    tx.touch(container.id)


def set_parameter(tx: Transaction, command: SetParameter) -> None:
    """Set a parameter; replaces an existing value."""
    container = find(tx, command.user, command.container)
    _check_value(command.name, command.value)
    there = container.parameters.get(command.name)
    if there == command.value and type(there) is type(command.value):
        return
    if there is None and len(container.parameters) >= tx.settings.max_parameters:
        raise LimitReachedError(
            f"container {container.tag!r} has {tx.settings.max_parameters} parameters already"
        )
    before = None if there is None else (command.name, there)
    size = endpoints.grown(tx, container, (command.name, command.value), before)
    # Removed first: 1 and True are equal, and an equal value must still replace the old one.
    kept = {n: v for n, v in container.parameters.items() if n != command.name}
    tx.put(replace(container, parameters=kept))
    tx.put(replace(container, parameters={**kept, command.name: command.value}, size=size))
    tx.touch(container.id)


def delete_parameter(tx: Transaction, command: DeleteParameter) -> None:
    """Delete a parameter."""
    container = find(tx, command.user, command.container)
    if command.name not in container.parameters:
        raise NotFoundError(f"container {container.tag!r} has no parameter {command.name!r}")
    kept = {n: v for n, v in container.parameters.items() if n != command.name}
    size = container.size - endpoints.size_of((command.name, container.parameters[command.name]))
    tx.put(replace(container, parameters=kept, size=size))
    tx.touch(container.id)


def _check_value(name: str, value: ParameterValue) -> None:
    """Refuse what a task set of the release before passes on unchecked."""
    try:
        read_parameter_value(value)
    except ValueError as error:
        raise InvalidRequestError(f"parameter {name!r}: {error}") from error


def find(tx: Transaction, user: str, tag: str) -> Container:
    """Find a container of a user.

    Raises:
        Refused: It does not exist; the text lists the existing ones.
    """
    found = tx.tables.endpoints.get(f"{user}/{tag}")
    if isinstance(found, Container):
        return found
    if found is not None:
        raise InvalidRequestError(f"{tag!r} is a robot, not a container")
    raise NotFoundError(f"there is no container {tag!r}; create it first")


# Reports of task sets


def lose(tx: Transaction, container: Container) -> None:
    """Give up a container at a task set that stayed away."""
    if draining.promote(tx, container):
        return
    volume_moves.lost(tx, container)
    text = f"container {container.tag!r} was lost with its machine {container.task_set!r}"
    _unbind(tx, container, ContainerEvent.LOSE)
    tx.notify(container.user, text)
    tx.happen("container_lost", container.id, text)


def ended(tx: Transaction, container: Container) -> None:
    """Note that a container's task set ended it although it is desired; it is placed again."""
    if draining.promote(tx, container):
        return
    if (move := tx.tables.volume_moves.get(container.id)) is not None:
        volume_moves.stopped(tx, container, move)
        return
    _unbind(tx, container, ContainerEvent.WITHDRAW)
    tx.happen("container_gone", container.id, "its task set ended it; it is placed again")


def _unbind(tx: Transaction, container: Container, event: ContainerEvent) -> None:
    endpoints.note_address(tx, container.id, LinkAddress())
    tx.put(replace(tx.tables.endpoints[container.id], task_set=""))
    placing.happened(tx, container.id, event)
    _forget_status(tx, container)


def missing(tx: Transaction, container: Container) -> None:
    """Note that a task set came back without a container that is placed there; it makes it again."""
    if (move := tx.tables.volume_moves.get(container.id)) is not None:
        volume_moves.stopped(tx, container, move)
        return
    live = tx.tables.container_live(container.id)
    if live.phase is not ContainerPhase.PLACED:
        placing.happened(tx, container.id, ContainerEvent.PLACE)
    _forget_status(tx, container)
    endpoints.note_address(tx, container.id, LinkAddress())


def _forget_status(tx: Transaction, container: Container) -> None:
    tx.put(replace(tx.tables.container_live(container.id), status=None))
    activity.forget(tx, container.id)


def reported(tx: Transaction, container: Container, status: EndpointStatus) -> None:
    """Apply a task set's report about a container, except its interfaces and connections."""
    before = tx.tables.container_live(container.id)
    event = _EVENTS[status.state]
    if before.after(event, tx.now).phase is not before.phase:
        placing.happened(tx, container.id, event)
        tx.happen(f"container_{event.value}", container.id, status.detail)
    elif before.status and before.status.incarnation != status.incarnation:
        tx.happen("container_restarted", container.id, status.detail)
    _compare_nodes(tx, container.id, before.status, status)
    tx.put(replace(tx.tables.container_live(container.id), status=status))
    endpoints.note_address(tx, container.id, status.address)
    failed = status.detail or "no reason was given" if status.state is EndpointState.FAILED else ""
    volume_moves.reported(tx, container, is_up=status.state in _UP, failed=failed)


def _compare_nodes(tx: Transaction, id_: str, before: EndpointStatus | None, now: EndpointStatus) -> None:
    old = {node.tag: node for node in before.nodes} if before else {}
    for node in now.nodes:
        was = old.get(node.tag)
        if was is not None and node.restarts > was.restarts:
            tx.happen("node_restarted", f"{id_}/{node.tag}", f"for the {_ordinal(node.restarts)} time")
        if was is None or (was.state, was.pid) != (node.state, node.pid):
            tx.happen(f"node_{node.state.value}", f"{id_}/{node.tag}", _node_text(node))


def _ordinal(number: int) -> str:
    teens = number % 100 in (11, 12, 13)
    return f"{number}{'th' if teens else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')}"


def _node_text(node: NodeStatus) -> str:
    if node.state is NodeState.FAILED and node.exit_code is not None and not node.detail:
        how = f"signal {-node.exit_code}" if node.exit_code < 0 else f"exit code {node.exit_code}"
        return f"ended by {how}"
    return node.detail
