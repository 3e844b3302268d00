"""What users may ask of the state, and what they are told if not."""

from __future__ import annotations

import itertools

import pytest
from support.master_world import World

from rce.link.settings import LinkLimits
from rce.model.specs import ParameterSpec, ParameterValue
from rce_master.exceptions import (
    ConflictError,
    InvalidRequestError,
    LimitReachedError,
    NotFoundError,
    RefusedError,
)
from rce_master.state import commands
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import UserRole


def revision(world: World, tag: str) -> int:
    return world.spec(tag).revision


def test_the_same_thing_again_is_accepted_and_changes_nothing(world: World) -> None:
    world.wired()
    world.node("c", "n")
    before = world.spec("c"), world.spec("rob")
    world.container()
    world.node("c", "n")
    world.interface("c/in", "PublisherInterface")
    world.interface("rob/out", "SubscriberConverter")
    world.connect("rob/out", "c/in")
    world.connect("c/in", "rob/out")
    assert (world.spec("c"), world.spec("rob")) == before


def test_something_else_under_the_same_tag_is_refused(world: World) -> None:
    world.wired()
    world.node("c", "n")
    with pytest.raises(
        ConflictError, match=r"container 'c' exists with other settings; resize or destroy it first"
    ):
        world.container(memory=5)
    with pytest.raises(
        ConflictError, match="node 'n' of container 'c' exists with other settings; remove it first"
    ):
        world.node("c", "n", exe="other.py")
    with pytest.raises(ConflictError, match="interface 'c/in' exists with other settings"):
        world.interface("c/in", "PublisherInterface", addr="/elsewhere")


def test_tags_are_unique_among_robots_and_containers(world: World) -> None:
    world.wired()
    with pytest.raises(ConflictError, match="'rob' is a robot already"):
        world.container("rob")
    with pytest.raises(ConflictError, match="'c' is a container"):
        world.login("c")


def test_forms_belong_to_their_end(world: World) -> None:
    world.wired()
    with pytest.raises(InvalidRequestError, match="a robot takes PublisherConverter or PublisherForwarder"):
        world.interface("rob/x", "PublisherInterface")
    with pytest.raises(InvalidRequestError, match="a container takes SubscriberInterface"):
        world.interface("c/x", "SubscriberForwarder", addr="/x")
    with pytest.raises(InvalidRequestError, match="addr is missing"):
        world.interface("c/x", "SubscriberInterface", addr="")
    with pytest.raises(InvalidRequestError, match="unknown interface type 'Nonsense'"):
        world.interface("c/x", "Nonsense")


def test_a_robots_local_address_is_ignored(world: World) -> None:
    world.wired()
    world.interface("rob/x", "PublisherForwarder", addr="/local")
    assert [i.addr for i in world.spec("rob").interfaces if i.tag == "x"] == [""]


def test_connections_need_complementing_roles_and_one_class(world: World) -> None:
    world.wired()
    world.interface("rob/sub", "SubscriberConverter")
    world.interface("c/sub", "SubscriberInterface")
    world.interface("c/number", "PublisherInterface", message_type="std_msgs/Int32")
    with pytest.raises(InvalidRequestError, match="a Subscriber connects to a Publisher"):
        world.connect("rob/sub", "c/sub")
    with pytest.raises(InvalidRequestError, match="must be the same"):
        world.connect("rob/sub", "c/number")
    with pytest.raises(NotFoundError, match="there is no interface 'c/nothing'; add it first"):
        world.connect("rob/sub", "c/nothing")
    with pytest.raises(NotFoundError, match="there is no robot or container 'nobody'"):
        world.connect("rob/sub", "nobody/x")
    with pytest.raises(InvalidRequestError, match="write ENDPOINT/INTERFACE"):
        world.connect("rob", "c/sub")
    with pytest.raises(InvalidRequestError, match="must be the same"):
        world.connect("c/sub", "c/number")
    with pytest.raises(InvalidRequestError, match="do not complete each other"):
        world.connect("c/sub", "c/sub")


def test_two_interfaces_of_one_endpoint_are_connected(world: World) -> None:
    """The endpoint is told of one link with itself, which nobody dials."""
    world.wired()
    world.interface("c/from", "SubscriberInterface")
    world.interface("c/to", "PublisherInterface")
    before = len(world.spec("c").connections)
    world.connect("c/to", "c/from")
    world.connect("c/from", "c/to")
    spec = world.spec("c")
    (link,) = [link for link in spec.links if link.peer == spec.id]
    assert not link.dial
    assert len(spec.connections) == before + 1
    assert {(c.interface, c.peer_interface) for c in spec.connections if c.link == link.id} == {
        ("from", "to")
    }
    world.do(commands.RemoveInterface(user="anna", endpoint="c", tag="to"))
    assert [link.peer for link in world.spec("c").links if link.peer == spec.id] == []


def test_own_service_takes_one_connection(world: World) -> None:
    """A service of an endpoint for itself takes one connection."""
    world.wired()
    for name in ("a_ask", "z_ask"):
        world.interface(f"c/{name}", "ServiceProviderInterface", message_type="std_srvs/Empty")
        world.interface("c/serve", "ServiceClientInterface", message_type="std_srvs/Empty")
        world.interface("c/other", "ServiceClientInterface", message_type="std_srvs/Empty")
        world.connect(f"c/{name}", "c/serve")
        with pytest.raises(ConflictError, match="takes one connection"):
            world.connect(f"c/{name}", "c/other")


def test_a_service_provider_takes_one_connection(world: World) -> None:
    world.wired()
    world.interface("rob/call", "ServiceProviderConverter", message_type="std_srvs/Empty")
    world.interface("c/one", "ServiceClientInterface", message_type="std_srvs/Empty")
    world.interface("c/two", "ServiceClientInterface", message_type="std_srvs/Empty")
    world.connect("rob/call", "c/one")
    with pytest.raises(ConflictError, match="takes one connection: disconnect it first"):
        world.connect("c/two", "rob/call")
    world.do(commands.Disconnect(user="anna", tag_a="c/one", tag_b="rob/call"))
    world.connect("c/two", "rob/call")


def test_disconnecting_what_is_not_connected_is_told(world: World) -> None:
    world.wired()
    world.interface("c/other", "PublisherInterface")
    with pytest.raises(NotFoundError, match="are not connected"):
        world.do(commands.Disconnect(user="anna", tag_a="rob/out", tag_b="c/other"))


def test_removing_interface_removes_connections_both_ends(world: World) -> None:
    """Removing an interface removes its connections at both ends."""
    world.wired()
    changes = world.do(commands.RemoveInterface(user="anna", endpoint="rob", tag="out"))
    assert set(changes.touched) == {"anna/rob", "anna/c"}
    assert world.spec("c").connections == ()
    assert world.spec("c").links == ()
    with pytest.raises(NotFoundError, match="there is no interface 'rob/out'"):
        world.do(commands.RemoveInterface(user="anna", endpoint="rob", tag="out"))


def test_destroying_a_container_removes_all_that_is_in_it(world: World) -> None:
    world.wired()
    world.node("c", "n")
    changes = world.do(commands.DestroyContainer(user="anna", tag="c"))
    assert set(changes.touched) == {"anna/rob"}
    assert world.spec("rob").links == ()
    assert [(w.process, w.id) for w in changes.withdrawals] == [("c1", "anna/c")]
    with pytest.raises(NotFoundError, match="there is no container 'c'; create it first"):
        world.node("c", "n")
    with pytest.raises(NotFoundError):
        world.do(commands.DestroyContainer(user="anna", tag="c"))
    with pytest.raises(InvalidRequestError, match="is a robot, not a container"):
        world.do(commands.DestroyContainer(user="anna", tag="rob"))


def test_users_do_not_see_each_other(world: World) -> None:
    world.wired()
    world.user("bert")
    world.login("bot", user="bert")
    world.interface("bot/in", "PublisherConverter", user="bert")
    with pytest.raises(NotFoundError):
        world.connect("bot/in", "rob/out", user="bert")
    with pytest.raises(NotFoundError):
        world.do(commands.DestroyContainer(user="bert", tag="c"))
    world.container("c", user="bert")
    assert world.spec("c", "bert").links == ()


def test_parameters_are_set_and_replaced(world: World) -> None:
    world.wired()

    def set_(value: ParameterValue) -> None:
        world.do(commands.SetParameter(user="anna", container="c", name="p", value=value))

    values: list[ParameterValue] = [1, True, 1.0, "one", [1, "a", False]]
    for value in values:
        before = revision(world, "c")
        set_(value)
        (found,) = world.spec("c").parameters
        assert found == ParameterSpec(name="p", value=value)
        assert type(found.value) is type(value)
        assert revision(world, "c") > before
    before = revision(world, "c")
    set_([1, "a", False])
    assert revision(world, "c") == before
    with pytest.raises(InvalidRequestError, match="must fit into 32 bits"):
        set_(2**31)
    with pytest.raises(InvalidRequestError, match="finite"):
        set_([1.0, float("nan")])
    world.do(commands.DeleteParameter(user="anna", container="c", name="p"))
    assert world.spec("c").parameters == ()
    with pytest.raises(NotFoundError, match="has no parameter 'p'"):
        world.do(commands.DeleteParameter(user="anna", container="c", name="p"))


def test_a_refused_command_changes_nothing_and_uses_no_number() -> None:
    world = World(StateSettings(max_containers=1, max_interfaces=1, max_nodes=1, max_parameters=1))
    world.wired()
    world.node("c", "n")
    before = {table.name: list(table) for table in world.state.tables.all}
    with pytest.raises(LimitReachedError):
        world.container("other")
    with pytest.raises(LimitReachedError):
        world.interface("c/more", "PublisherInterface")
    with pytest.raises(LimitReachedError):
        world.node("c", "more")
    with pytest.raises(RefusedError):
        world.login("rob")
    assert {table.name: list(table) for table in world.state.tables.all} == before


def test_connections_of_two_endpoints_are_limited() -> None:
    """Their link takes no more; what is there is accepted, and other endpoints have links of their own."""
    world = World(StateSettings(max_link_connections=2))
    world.wired()
    world.container("other")
    for path in ("c/in2", "c/in3", "other/in"):
        world.interface(path, "PublisherInterface")
    world.connect("rob/out", "c/in2")
    with pytest.raises(LimitReachedError, match="'c' and 'rob' have 2 connections already"):
        world.connect("rob/out", "c/in3")
    world.connect("rob/out", "c/in2")
    world.connect("rob/out", "other/in")
    world.do(commands.Disconnect(user="anna", tag_a="rob/out", tag_b="c/in"))
    world.connect("rob/out", "c/in3")


def test_a_link_takes_all_connections_that_the_master_allows() -> None:
    assert StateSettings().max_link_connections <= LinkLimits().max_channels


def test_connection_ids_and_links_are_never_used_again(world: World) -> None:
    world.wired()
    first, link = world.spec("c").connections[0], world.spec("c").links[0]
    world.do(commands.Disconnect(user="anna", tag_a="rob/out", tag_b="c/in"))
    world.connect("rob/out", "c/in")
    second, new = world.spec("c").connections[0], world.spec("c").links[0]
    assert second.id > first.id
    assert (new.id, new.token) != (link.id, link.token)
    assert new.token != link.token


def test_one_link_for_all_connections_of_two_endpoints(world: World) -> None:
    world.wired()
    world.interface("rob/in", "PublisherForwarder")
    world.interface("c/out", "SubscriberInterface")
    world.connect("c/out", "rob/in")
    mine, theirs = world.spec("rob"), world.spec("c")
    assert len(mine.links) == len(theirs.links) == 1
    assert {(c.id, c.interface, c.peer_interface) for c in mine.connections} == {
        (c.id, c.peer_interface, c.interface) for c in theirs.connections
    }
    assert mine.links[0].token == theirs.links[0].token
    assert (mine.links[0].peer, theirs.links[0].peer) == ("anna/c", "anna/rob")


def test_robot_dials_container_smaller_id_dials_equal(world: World) -> None:
    """The robot dials the container and the smaller id its equal."""
    world.wired()
    world.run()
    world.login("abel")
    world.interface("abel/in", "PublisherConverter")
    world.connect("abel/in", "rob/out")
    world.container("a")
    world.interface("a/out", "SubscriberInterface")
    world.connect("a/out", "c/in")
    dial = {
        (tag, link.peer): (link.dial, link.address)
        for tag in ("rob", "c", "abel", "a")
        for link in world.spec(tag).links
    }
    assert [key for key, (dials, _) in dial.items() if dials] == [
        ("rob", "anna/c"),
        ("abel", "anna/rob"),
        ("a", "anna/c"),
    ]
    assert dial["rob", "anna/c"][1].unix == "/run/c"
    assert dial["abel", "anna/rob"][1].port == 1
    assert dial["a", "anna/c"][1].unix == "/run/c"


def test_the_last_administrator_stays(world: World) -> None:
    world.user("root", UserRole.ADMIN)
    with pytest.raises(ConflictError, match="last administrator"):
        world.do(commands.RemoveUser(name="root"))
    world.user("second", UserRole.ADMIN)
    world.do(commands.RemoveUser(name="root"))


def test_a_large_user_is_removed_by_several_commands() -> None:
    """None of them does more than its share, and the user is there until the last."""
    world = World(StateSettings(max_work=1000))
    world.robot_set()
    world.container_set()
    world.container()
    for number in range(30):
        world.login(f"rob{number}")
        for tag in ("a", "b"):
            world.interface(f"rob{number}/{tag}", "SubscriberConverter")
    world.interface("c/in", "PublisherInterface")
    for number in range(30):
        world.connect(f"rob{number}/a", "c/in")
    left = [len(world.state.tables.endpoints)]
    while "anna" in world.state.tables.users:
        world.do(commands.RemoveUser(name="anna"))
        left.append(len(world.state.tables.endpoints))
    assert left[-1] == 0
    assert len(left) > 3
    assert max(before - after for before, after in itertools.pairwise(left)) < 15
    assert not world.state.tables.links


def test_a_removed_user_leaves_nothing(world: World) -> None:
    world.wired()
    changes = world.do(commands.RemoveUser(name="anna"))
    assert {(w.process, w.id) for w in changes.withdrawals} == {("r1", "anna/rob"), ("c1", "anna/c")}
    assert len(world.state.tables.endpoints) == 0
    assert len(world.state.tables.links) == 0
