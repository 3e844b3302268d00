"""The invariants of the state between two commands."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rce.control import TaskSetKind
from rce.model import EndpointId, Form, InterfaceType, Network, Resources, Role, split_package
from rce_master.state import capacity, endpoints, robots
from rce_master.state.lifecycle import RobotSession, VolumeMovePhase
from rce_master.state.placement import Room
from rce_master.state.promises import Promises
from rce_master.state.records import Container, ContainerLive, Endpoint, Robot, RobotLive
from rce_master.state.waiting import group_key

if TYPE_CHECKING:
    from rce_master.state.tables import Tables
    from rce_master.state.wiring_records import Link


def validate(tables: Tables) -> None:
    """Check all invariants.

    Raises:
        AssertionError: An invariant does not hold; the text says which.
    """
    _check_indexes(tables)
    _check_rooms(tables)
    _check_queue(tables)
    _check_package_uses(tables)
    for endpoint in tables.endpoints:
        _check_endpoint(tables, endpoint)
    for link in tables.links:
        _check_link(tables, link)
    _check_connections(tables)
    _check_observed(tables)
    _check_groups(tables)
    _check_moves(tables)
    _check_volumes(tables)
    for state in tables.saved_states:
        assert tables.container(state.container) is not None, f"{state.id}: its container is unknown"
    _check_users_records(tables)


def _check_users_records(tables: Tables) -> None:
    """Check that what belongs to a user has one."""
    of_users = (tables.packages, tables.package_keys, tables.known_logins, tables.user_limits, tables.answers)
    for record in (record for table in of_users for record in table):
        assert record.user in tables.users, f"{record}: its user is unknown"


def _check_indexes(tables: Tables) -> None:
    for table in tables.all:
        for key, record in ((table.key(r), r) for r in table):
            assert table.get(key) is record, f"{table.name}: {key} is not under its key"
        for index in table.indexes:
            kept = {value: sorted(keys) for value, keys in table.index_entries(index).items()}
            computed = {value: sorted(keys) for value, keys in table.computed_entries(index).items()}
            assert kept == computed, f"{table.name}: index {index} is out of date"
        assert table.totals == table.computed_totals, f"{table.name}: totals are out of date"


def _check_package_uses(tables: Tables) -> None:
    counts: dict[tuple[str, ...], Counter[str]] = {}
    for container in tables.containers():
        for node in container.nodes.values():
            counts.setdefault((container.user, *split_package(node.pkg)), Counter())[container.id] += 1
    assert tables.package_uses.counts == counts, "the nodes of packages are out of date"


def _check_rooms(tables: Tables) -> None:
    """Compare the rooms with a new count of all containers."""
    promised, requested = Promises(), Promises()
    of_users: dict[str, Counter[str]] = {}
    for container in tables.containers():
        requested.add(container.user, container.resources)
        if container.task_set:
            promised.add(container.task_set, container.resources)
            of_users.setdefault(container.user, Counter())[container.task_set] += 1
    for move in (*tables.moves, *tables.volume_moves):
        coming = tables.container(move.id)
        if coming is not None and move.to:
            promised.add(move.to, coming.resources)
    assert tables.rooms.promises.sums == promised.sums, "promises of machines are out of date"
    assert tables.requested.sums == requested.sums, "what users ask for is out of date"
    for user in tables.users:
        assert tables.rooms.of_user(user.name) == of_users.get(user.name, {}), f"{user.name}: places"
    machines = [s for s in tables.task_sets if s.kind is TaskSetKind.CONTAINER]
    names = Counter(s.machine.name for s in machines)
    computed = {
        s.process: Room(
            process=s.process,
            machine=s.machine,
            alias=s.process if names[s.machine.name] > 1 else "",
            draining=s.machine.draining or s.process in tables.drains,
            slots=(sums := promised.sum_of(s.process)).slots,
            cpu=sums.cpu,
            memory=sums.memory_of(s.machine.memory // s.machine.slots if s.machine.slots else 0),
            containers=sums.containers,
        )
        for s in machines
    }
    assert {room.process: room for room in tables.rooms} == computed, "rooms are out of date"
    open_ = [room for room in computed.values() if tables.is_connected(room.process) and not room.draining]
    order = sorted(open_, key=lambda room: (room.load_with(Resources()), room.process))
    assert tables.rooms.order == [room.process for room in order], "the order of machines is out of date"


def _check_queue(tables: Tables) -> None:
    """Check that all that wait are in the queue, and that what need not be looked at fits nowhere."""
    waiting = sorted((c for c in tables.containers() if not c.task_set), key=lambda c: c.number)
    assert tables.queue.waiting == [c.id for c in waiting], "the queue is out of date"
    if tables.queue.has_work:
        return
    for container in waiting:
        tied, admits = capacity.tied_to(tables, container), capacity.admission(tables, container)
        for room in tables.rooms.connected:
            is_open = (tied is None or room.process in tied) and admits(room.process)
            assert not (is_open and room.fits(container.resources)), (
                f"{container.id}: waits, and {room.process} has room"
            )


def _check_endpoint(tables: Tables, endpoint: Endpoint) -> None:
    id_ = endpoint.id
    assert EndpointId.parse(id_).user in tables.users, f"{id_}: its user is unknown"
    assert 0 < endpoint.revision <= _counter(tables, "revision"), f"{id_}: revision {endpoint.revision}"
    for interface in (one.spec for one in tables.interfaces.by("endpoint", id_)):
        tag = interface.tag
        form = InterfaceType.parse(interface.type).form
        in_container = isinstance(endpoint, Container)
        assert (form is Form.INTERFACE) == in_container, f"{id_}/{tag}: {interface.type} is of the wrong form"
        assert bool(interface.addr) == in_container, f"{id_}/{tag}: addr {interface.addr!r}"
    size = _size(tables, endpoint)
    assert endpoint.size == size, f"{id_}: size {endpoint.size}, not {size}"
    if endpoint.task_set:
        task_set = tables.task_sets.get(endpoint.task_set)
        assert task_set is not None, f"{id_}: placed at an unknown task set"
        assert task_set.kind.value == endpoint.kind.value, f"{id_}: placed at a task set of the wrong kind"


def _size(tables: Tables, endpoint: Endpoint) -> int:
    parts: list[object] = [one.spec for one in tables.interfaces.by("endpoint", endpoint.id)]
    if isinstance(endpoint, Container):
        parts += [endpoint.resources, *endpoint.nodes.values(), *endpoint.parameters.items()]
    return sum(map(endpoints.size_of, parts))


def _check_link(tables: Tables, link: Link) -> None:
    assert link.a <= link.b, f"{link.id}: ends out of order"
    assert link.token, f"{link.id}: no token"
    assert tables.connections.count("link", link.id), f"{link.id}: no connection"
    a, b = tables.endpoints.get(link.a), tables.endpoints.get(link.b)
    assert a is not None, f"{link.id}: {link.a} is not there"
    assert b is not None, f"{link.id}: {link.b} is not there"
    assert a.user == b.user, f"{link.id}: joins two users"
    assert [x for x in tables.links.by("endpoint", link.a) if x.peer(link.a) == link.b] == [link], (
        f"{link.id}: a second link of the same endpoints"
    )
    for connection in tables.connections.by("link", link.id):
        id_ = connection.id
        assert (connection.a, connection.b) == (link.a, link.b), f"{link.id}/{id_}: other endpoints"
        one, other = (tables.interfaces[key].spec for key in connection.ends)
        roles = InterfaceType.parse(one.type).role, InterfaceType.parse(other.type).role
        assert roles[0].complement is roles[1], f"{link.id}/{id_}: roles do not complete each other"
        assert one.message_type == other.message_type, f"{link.id}/{id_}: classes differ"


def _check_connections(tables: Tables) -> None:
    ids = [connection.id for connection in tables.connections]
    assert max(ids, default=0) <= _counter(tables, "connection"), "a connection id was not counted"
    numbers = [interface.number for interface in tables.interfaces]
    assert max(numbers, default=0) <= _counter(tables, "interface"), "an interface was not counted"
    for interface in tables.interfaces:
        assert interface.endpoint in tables.endpoints, f"{interface.id}: its endpoint is gone"
    for connection in tables.connections:
        assert connection.link in tables.links, f"connection {connection.id}: its link is gone"
    pairs = Counter(connection.ends for connection in tables.connections)
    assert all(count == 1 for count in pairs.values()), "two interfaces are connected twice"
    ends = Counter(end for connection in tables.connections for end in connection.ends)
    for end, count in ends.items():
        role = InterfaceType.parse(tables.interfaces[end].spec.type).role
        assert role is not Role.SERVICE_PROVIDER or count == 1, f"{end}: {count} connections"


def _check_observed(tables: Tables) -> None:
    assert {o.id for o in tables.live} == {e.id for e in tables.endpoints}, "live and endpoints differ"
    assert {p.process for p in tables.presence} == {s.process for s in tables.task_sets}, (
        "presence and task sets differ"
    )
    for part in (*tables.active, *tables.open_ends):
        assert tables.live[part.endpoint].status is not None, f"{part.id}: known without a status"
    for live in tables.live:
        endpoint = tables.endpoints[live.id]
        if isinstance(live, RobotLive):
            assert isinstance(endpoint, Robot), f"{live.id}: a robot's observation of a container"
            assert live.session is not RobotSession.OFFLINE, f"{live.id}: offline robots have no endpoint"
            if live.session is RobotSession.CONNECTED:
                presence = tables.presence.get(endpoint.task_set)
                assert presence is not None and (presence.connected or presence.leaving), (  # noqa: PT018
                    f"{live.id}: connected at a task set that is away"
                )
                assert not robots.why_locked_out(tables, endpoint) or endpoint.user in tables.lockouts, (
                    f"{live.id}: connected and locked out"
                )
        else:
            _check_container(tables, live)
    for tombstone in tables.tombstones:
        assert tables.is_connected(tombstone.process), f"{tombstone.key}: its task set is away"
        assert tables.task_sets[tombstone.process].kind is TaskSetKind.CONTAINER, (
            f"{tombstone.key}: no container"
        )


def _check_container(tables: Tables, live: ContainerLive) -> None:
    container = tables.container(live.id)
    assert container is not None, f"{live.id}: a container's observation of a robot"
    assert live.phase.is_placed == bool(container.task_set), (
        f"{live.id}: {live.phase} at {container.task_set!r}"
    )
    if container.task_set:
        tombstone = f"{container.task_set} {container.id}"
        assert tombstone not in tables.tombstones, f"{live.id}: placed where its former self still ends"


def _check_groups(tables: Tables) -> None:
    """Check that the network of a group is on one machine: the nodes reach each other only there."""
    places: dict[str, set[str]] = {}
    for container in tables.containers():
        if container.resources.network is Network.GROUP and container.task_set:
            places.setdefault(group_key(container), set()).add(container.task_set)
    for key, found in places.items():
        assert len(found) == 1, f"the network of group {key!r} is on several machines: {sorted(found)}"


def _check_moves(tables: Tables) -> None:
    for move in tables.moves:
        container = tables.container(move.id)
        assert container is not None, f"{move.id}: moves and is not a container"
        assert container.task_set, f"{move.id}: moves and is placed nowhere"
        assert move.to != container.task_set, f"{move.id}: moves to where it is"
        assert tables.is_connected(move.to), f"{move.id}: moves to {move.to}, which is away"
        assert tables.task_sets[move.to].kind is TaskSetKind.CONTAINER, f"{move.id}: moves to robots"
        assert f"{move.to} {move.id}" not in tables.tombstones, f"{move.id}: moves to where it still ends"


def _check_volumes(tables: Tables) -> None:
    for known in tables.volumes:
        assert known.process not in known.former, f"{known.id}: its newest folder would be removed"
        assert bool(known.placement) == bool(known.process), f"{known.id}: placement {known.placement}"
    for move in tables.volume_moves:
        container = tables.container(move.id)
        assert container is not None, f"{move.id}: moves and is not a container"
        assert container.resources.volumes, f"{move.id}: moves with volumes and has none"
        assert move.id not in tables.moves, f"{move.id}: moves in two ways"
        is_early = move.phase in (VolumeMovePhase.STOPPING, VolumeMovePhase.SAVING)
        assert container.task_set or not is_early, f"{move.id}: {move.phase} and placed nowhere"
        assert bool(move.to) != (move.phase is VolumeMovePhase.RESTING), (
            f"{move.id}: {move.phase} to {move.to!r}"
        )
        assert not move.to or move.to != container.task_set, f"{move.id}: moves to where it is"


def _counter(tables: Tables, name: str) -> int:
    counter = tables.counters.get(name)
    return counter.value if counter else 0
