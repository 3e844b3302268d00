"""What always holds between two commands."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rce.control.messages import TaskSetKind
from rce.model.names import EndpointId, Form, InterfaceType, Role
from rce_master.state import endpoints
from rce_master.state.lifecycle import RobotSession
from rce_master.state.records import Container, ContainerLive, Endpoint, Link, Robot, RobotLive

if TYPE_CHECKING:
    from rce_master.state.tables import Tables


def validate(tables: Tables) -> None:
    """Check all invariants.

    Raises:
        AssertionError: One does not hold; the text says which.
    """
    _check_indexes(tables)
    for endpoint in tables.endpoints:
        _check_endpoint(tables, endpoint)
    for link in tables.links:
        _check_link(tables, link)
    _check_connections(tables)
    _check_observed(tables)
    _check_moves(tables)
    for record in (*tables.packages, *tables.package_keys, *tables.known_logins, *tables.user_limits):
        assert record.user in tables.users, f"{record}: its user is unknown"


def _check_indexes(tables: Tables) -> None:
    for table in tables.all:
        for key, record in ((table.key(r), r) for r in table):
            assert table.get(key) is record, f"{table.name}: {key} is not under its key"
        for index in table.indexes:
            kept = {value: sorted(keys) for value, keys in table.index_entries(index).items()}
            computed = {value: sorted(keys) for value, keys in table.computed_entries(index).items()}
            assert kept == computed, f"{table.name}: index {index} is out of date"


def _check_endpoint(tables: Tables, endpoint: Endpoint) -> None:
    id_ = endpoint.id
    assert EndpointId.parse(id_).user in tables.users, f"{id_}: its user is unknown"
    assert 0 < endpoint.revision <= _counter(tables, "revision"), f"{id_}: revision {endpoint.revision}"
    for tag, interface in endpoint.interfaces.items():
        assert tag == interface.tag, f"{id_}/{tag}: stored under another tag"
        form = InterfaceType.parse(interface.type).form
        in_container = isinstance(endpoint, Container)
        assert (form is Form.INTERFACE) == in_container, f"{id_}/{tag}: {interface.type} is of the wrong form"
        assert bool(interface.addr) == in_container, f"{id_}/{tag}: addr {interface.addr!r}"
    assert endpoint.size == _size(endpoint), f"{id_}: size {endpoint.size}, not {_size(endpoint)}"
    if endpoint.task_set:
        task_set = tables.task_sets.get(endpoint.task_set)
        assert task_set is not None, f"{id_}: placed at an unknown task set"
        assert task_set.kind.value == endpoint.kind.value, f"{id_}: placed at a task set of the wrong kind"


def _size(endpoint: Endpoint) -> int:
    parts: list[object] = [*endpoint.interfaces.values()]
    if isinstance(endpoint, Container):
        parts += [endpoint.resources, *endpoint.nodes.values(), *endpoint.parameters.items()]
    return sum(map(endpoints.size_of, parts))


def _check_link(tables: Tables, link: Link) -> None:
    assert link.a <= link.b, f"{link.id}: ends out of order"
    assert link.token, f"{link.id}: no token"
    assert link.connections, f"{link.id}: no connection"
    a, b = tables.endpoints.get(link.a), tables.endpoints.get(link.b)
    assert a is not None, f"{link.id}: {link.a} is not there"
    assert b is not None, f"{link.id}: {link.b} is not there"
    assert a.user == b.user, f"{link.id}: joins two users"
    assert [x for x in tables.links.by("endpoint", link.a) if x.peer(link.a) == link.b] == [link], (
        f"{link.id}: a second link of the same endpoints"
    )
    for id_, connection in link.connections.items():
        assert id_ == connection.id, f"{link.id}: connection under the wrong id"
        one, other = a.interfaces[connection.interface_a], b.interfaces[connection.interface_b]
        roles = InterfaceType.parse(one.type).role, InterfaceType.parse(other.type).role
        assert roles[0].complement is roles[1], f"{link.id}/{id_}: roles do not complete each other"
        assert one.message_type == other.message_type, f"{link.id}/{id_}: classes differ"


def _check_connections(tables: Tables) -> None:
    ids = Counter(id_ for link in tables.links for id_ in link.connections)
    assert all(count == 1 for count in ids.values()), "a connection id is used twice"
    assert max(ids, default=0) <= _counter(tables, "connection"), "a connection id was not counted"
    ends = Counter(
        end
        for link in tables.links
        for c in link.connections.values()
        for end in ((link.a, c.interface_a), (link.b, c.interface_b))
    )
    for (endpoint, tag), count in ends.items():
        role = InterfaceType.parse(tables.endpoints[endpoint].interfaces[tag].type).role
        assert role is not Role.SERVICE_PROVIDER or count == 1, f"{endpoint}/{tag}: {count} connections"


def _check_observed(tables: Tables) -> None:
    assert {o.id for o in tables.live} == {e.id for e in tables.endpoints}, "live and endpoints differ"
    assert {p.process for p in tables.presence} == {s.process for s in tables.task_sets}, (
        "presence and task sets differ"
    )
    for live in tables.live:
        endpoint = tables.endpoints[live.id]
        if isinstance(live, RobotLive):
            assert isinstance(endpoint, Robot), f"{live.id}: a robot's observation of a container"
            assert live.session is not RobotSession.OFFLINE, f"{live.id}: offline robots have no endpoint"
            if live.session is RobotSession.CONNECTED:
                assert tables.is_connected(endpoint.task_set), (
                    f"{live.id}: connected at a task set that is away"
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


def _check_moves(tables: Tables) -> None:
    for move in tables.moves:
        container = tables.container(move.id)
        assert container is not None, f"{move.id}: moves and is no container"
        assert container.task_set, f"{move.id}: moves and is placed nowhere"
        assert move.to != container.task_set, f"{move.id}: moves to where it is"
        assert tables.is_connected(move.to), f"{move.id}: moves to {move.to}, which is away"
        assert tables.task_sets[move.to].kind is TaskSetKind.CONTAINER, f"{move.id}: moves to robots"
        assert f"{move.to} {move.id}" not in tables.tombstones, f"{move.id}: moves to where it still ends"


def _counter(tables: Tables, name: str) -> int:
    counter = tables.counters.get(name)
    return counter.value if counter else 0
