"""Records that are read from the store share what is equal, and are otherwise as they were written."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from rce.control import CONTROL_VERSION, Hello, MachineInfo, TaskSetKind
from rce.model import InterfaceSpec, NodeSpec, Resources
from rce_master.state import commands
from rce_master.state.core import State
from rce_master.state.sharing import LARGEST, Pool
from rce_master.state.user_records import User, UserRole

if TYPE_CHECKING:
    from rce_master.state.table import Table

Rows = dict[str, dict[str, bytes]]


@pytest.fixture
def rows() -> Rows:
    """Return the rows of two containers with equal nodes, a third with another one, and their connections."""
    state, stored = State(), Rows()

    def do(command: commands.Command) -> None:
        for row in state.apply(command, 1000.0).rows():
            if row.body is None:
                stored[row.table].pop(row.key)
            else:
                stored.setdefault(row.table, {})[row.key] = row.body

    do(commands.AddUser(user=User(name="ann", role=UserRole.ADMIN, password="", created=0.0)))
    machine = MachineInfo(name="m", cores=8, memory=2**34, slots=20)
    hello = Hello(version=CONTROL_VERSION, kind=TaskSetKind.CONTAINER, process="machine", machine=machine)
    do(commands.TaskSetArrived(hello=hello))
    for tag, args in (("one", ""), ("two", ""), ("other", "--slow")):
        do(commands.CreateContainer(user="ann", tag=tag, resources=Resources(cpu=0.5, memory=2**26)))
        do(
            commands.AddNode(
                user="ann", container=tag, node=NodeSpec(tag="n", pkg="nav", exe="plan", args=args)
            )
        )
        for end, type_ in (("out", "PublisherInterface"), ("in", "SubscriberInterface")):
            spec = InterfaceSpec(tag=end, type=type_, message_type="std_msgs/String", addr="/x")
            do(commands.AddInterface(user="ann", endpoint=tag, interface=spec))
    for a, b in (("one", "two"), ("two", "other")):
        do(commands.Connect(user="ann", tag_a=f"{a}/out", tag_b=f"{b}/in"))
    return stored


def read(rows: Rows) -> State:
    """Read rows as a stand-by does, one after another."""
    state = State()
    for table, found in rows.items():
        for key, body in found.items():
            assert state.write_row(table, key, bytes(body))
    return state


@pytest.mark.parametrize("how", ["load", "write"])
def test_what_is_equal_is_kept_once(rows: Rows, how: str) -> None:
    tables = (State.load(rows, 0.0) if how == "load" else read(rows)).tables
    one, two, other = (tables.container(f"ann/{tag}") for tag in ("one", "two", "other"))
    assert one is not None
    assert two is not None
    assert other is not None
    assert one.resources is two.resources is other.resources
    assert one.task_set is two.task_set
    assert one.nodes["n"] is two.nodes["n"]
    assert one.nodes["n"] is not other.nodes["n"]
    assert one.nodes["n"].pkg is other.nodes["n"].pkg
    assert one.address is two.address
    ends = {tag: tables.interfaces[f"ann/{tag}/out"] for tag in ("one", "two")}
    assert ends["one"].spec is ends["two"].spec
    assert ends["one"].endpoint is one.id
    link = tables.link_between("ann/one", "ann/two")
    assert link is not None
    assert {id(link.a), id(link.b)} == {id(one.id), id(two.id)}
    first, second = tables.connections
    assert id(first.a) in {id(one.id), id(two.id)}
    assert id(second.b) in {id(two.id), id(other.id)}
    assert first.link is not second.link


@pytest.mark.parametrize("how", ["load", "write"])
def test_records_are_as_they_were_written(rows: Rows, how: str) -> None:
    tables = (State.load(rows, 0.0) if how == "load" else read(rows)).tables
    shared: list[Table[Any]] = [tables.endpoints, tables.interfaces, tables.links, tables.connections]
    for table in shared:
        written = {key: json.loads(body) for key, body in rows[table.name].items()}
        assert {table.key(record): json.loads(table.encode(record)) for record in table} == written


def test_a_change_of_one_container_leaves_those_it_shares_with(rows: Rows) -> None:
    state = State.load(rows, 0.0)
    spec = NodeSpec(tag="more", pkg="nav", exe="plan")
    state.apply(commands.AddNode(user="ann", container="one", node=spec), 0.0)
    state.apply(commands.RemoveNode(user="ann", container="one", tag="n"), 0.0)
    found = {tag: state.tables.container(f"ann/{tag}") for tag in ("one", "two")}
    assert {tag: list(one.nodes) for tag, one in found.items() if one} == {"one": ["more"], "two": ["n"]}
    state.validate()


def test_large_records_are_not_remembered(rows: Rows) -> None:
    rows["endpoints"] = {
        key: body.replace(b'"exe":"plan"', b'"exe":"plan","name":"' + b"x" * LARGEST + b'"')
        for key, body in rows["endpoints"].items()
    }
    tables = State.load(rows, 0.0).tables
    one, two = (tables.container(f"ann/{tag}") for tag in ("one", "two"))
    assert one is not None
    assert two is not None
    assert one.nodes["n"] == two.nodes["n"]
    assert one.nodes["n"] is not two.nodes["n"]


def test_a_pool_is_bounded_and_goes_on() -> None:
    pool = Pool(most=3)
    for number in range(10):
        pool.one(f"text {number}")
        assert len(pool) <= 3
    kept, again = (f"text {number}" for number in (9, 9))
    assert kept is not again
    assert pool.one(again) is pool.one(kept)


def test_a_pool_does_not_mistake_types() -> None:
    pool = Pool()
    assert pool.one(1) is not pool.one(1.0)
    assert type(pool.one(True)) is bool
