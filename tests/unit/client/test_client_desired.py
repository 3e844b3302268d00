"""What a client remembers of what it has made."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rce.model.requests import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParameter,
)
from rce.model.specs import InterfaceSpec, NodeSpec, ParameterSpec, ResourceChanges
from rce_client.desired import Desired, merge_removals

TAGS = st.sampled_from(["a", "b", "robot"])
NAMES = st.sampled_from(["x", "y"])
PATHS = st.builds("{}/{}".format, TAGS, NAMES)


def components(**items: object) -> ConfigureComponents:
    return ConfigureComponents(**{key: (item,) for key, item in items.items()})  # type: ignore[arg-type]  # each key has items of its own


def interface(endpoint: str, tag: str) -> AddInterface:
    return AddInterface(
        endpoint=endpoint,
        interface=InterfaceSpec(tag=tag, type="PublisherConverter", message_type="p/T"),
    )


def node(container: str, tag: str) -> AddNode:
    return AddNode(container=container, node=NodeSpec(tag=tag, pkg="p", exe="e"))


REQUESTS: st.SearchStrategy[Request] = st.one_of(
    st.builds(lambda tag: CreateContainer(tag=tag), TAGS),
    st.builds(lambda tag: DestroyContainer(tag=tag), TAGS),
    st.builds(
        lambda tag, **data: ResizeContainer(tag=tag, changes=ResourceChanges(**data)),
        TAGS,
        cpu=st.sampled_from([None, 1.0, 0.5]),
        memory=st.sampled_from([None, 5]),
    ),
    st.builds(
        lambda c, n: components(add_nodes=node(c, n)),
        TAGS,
        NAMES,
    ),
    st.builds(lambda c, n: components(remove_nodes=RemoveNode(container=c, tag=n)), TAGS, NAMES),
    st.builds(lambda e, i: components(add_interfaces=interface(e, i)), TAGS, NAMES),
    st.builds(
        lambda e, i: components(remove_interfaces=RemoveInterface(endpoint=e, tag=i)),
        TAGS,
        NAMES,
    ),
    st.builds(
        lambda c, n: components(
            set_param=SetParameter(container=c, parameter=ParameterSpec(name=n, value=1))
        ),
        TAGS,
        NAMES,
    ),
    st.builds(lambda c, n: components(delete_param=DeleteParameter(container=c, name=n)), TAGS, NAMES),
    st.builds(lambda a, b: ConfigureConnections(connect=(Connection(tag_a=a, tag_b=b),)), PATHS, PATHS),
    st.builds(lambda a, b: ConfigureConnections(disconnect=(Connection(tag_a=a, tag_b=b),)), PATHS, PATHS),
)


def same(a: Desired, b: Desired) -> bool:
    return vars(a) == vars(b)


@given(st.lists(REQUESTS, max_size=30))
def test_restoring_makes_the_same_again(requests: list[Request]) -> None:
    desired, again = Desired(), Desired()
    for request in requests:
        desired.apply(request)
    for request in desired.restore():
        again.apply(request)
    assert same(desired, again)
    for request in desired.restore():
        desired.apply(request)
    assert same(desired, again)


@given(st.lists(REQUESTS, max_size=30))
def test_undoing_leaves_nothing(requests: list[Request]) -> None:
    desired = Desired()
    for request in requests:
        desired.apply(request)
    for request in desired.undo():
        desired.apply(request)
    assert desired.restore() == []
    assert desired.undo() == []


def test_a_destroyed_container_takes_what_is_in_it_along() -> None:
    desired = Desired()
    for request in (
        CreateContainer(tag="c"),
        components(add_nodes=node("c", "n")),
        components(add_interfaces=interface("c", "x")),
        components(add_interfaces=interface("cc", "x")),
        ConfigureConnections(connect=(Connection(tag_a="c/x", tag_b="cc/x"),)),
        ConfigureConnections(connect=(Connection(tag_a="cc/x", tag_b="robot/x"),)),
        DestroyContainer(tag="c"),
    ):
        desired.apply(request)
    assert not desired.nodes
    assert list(desired.interfaces) == [("cc", "x")]
    assert list(desired.connections) == [frozenset(("cc/x", "robot/x"))]


def test_undoing_disconnects_first_and_destroys_last() -> None:
    desired = Desired()
    desired.apply(CreateContainer(tag="c"))
    desired.apply(components(add_interfaces=interface("robot", "x")))
    desired.apply(components(add_interfaces=interface("c", "x")))
    desired.apply(ConfigureConnections(connect=(Connection(tag_a="c/x", tag_b="robot/x"),)))
    first, second, third = desired.undo()
    assert isinstance(first, ConfigureConnections)
    assert second == components(remove_interfaces=RemoveInterface(endpoint="robot", tag="x"))
    assert third == DestroyContainer(tag="c")


def test_who_is_named_first_in_a_connection_means_nothing() -> None:
    desired = Desired()
    desired.apply(ConfigureConnections(connect=(Connection(tag_a="a/x", tag_b="b/x"),)))
    desired.apply(ConfigureConnections(disconnect=(Connection(tag_a="b/x", tag_b="a/x"),)))
    assert not desired.connections


def test_a_container_is_made_again_as_it_was_and_then_resized() -> None:
    desired = Desired()
    made = CreateContainer(tag="a")
    desired.apply(made)
    for data in (ResourceChanges(cpu=1.0), ResourceChanges(memory=1 << 30), ResourceChanges(cpu=0.5)):
        desired.apply(ResizeContainer(tag="a", changes=data))
    resized = ResizeContainer(tag="a", changes=ResourceChanges(cpu=0.5, memory=1 << 30))
    assert desired.restore() == [made, resized]


def test_removals_are_merged_in_their_order() -> None:
    cut = [ConfigureConnections(disconnect=(Connection(tag_a=f"a/{name}", tag_b="b/x"),)) for name in "xy"]
    gone = [components(remove_interfaces=RemoveInterface(endpoint="robot", tag=name)) for name in "xy"]
    destroyed = DestroyContainer(tag="a")
    first, second, third, last = merge_removals([*cut, *gone, destroyed, gone[0]])
    assert first == ConfigureConnections(disconnect=cut[0].disconnect + cut[1].disconnect)
    assert second == ConfigureComponents(
        remove_interfaces=gone[0].remove_interfaces + gone[1].remove_interfaces
    )
    assert (third, last) == (destroyed, gone[0])
