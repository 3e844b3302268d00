"""What a client remembers of what it has made."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rce.protocol.messages import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParam,
    DestroyContainer,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    ResizeData,
    SetParam,
)
from rce_client.desired import Desired

TAGS = st.sampled_from(["a", "b", "robot"])
NAMES = st.sampled_from(["x", "y"])
PATHS = st.builds("{}/{}".format, TAGS, NAMES)


def components(**items: object) -> ConfigureComponents:
    return ConfigureComponents(**{key: (item,) for key, item in items.items()})  # type: ignore[arg-type]


def interface(endpoint: str, tag: str) -> AddInterface:
    return AddInterface(
        endpoint_tag=endpoint, interface_tag=tag, interface_type="PublisherConverter", message_type="p/T"
    )


REQUESTS: st.SearchStrategy[Request] = st.one_of(
    st.builds(lambda tag: CreateContainer(container_tag=tag), TAGS),
    st.builds(lambda tag: DestroyContainer(container_tag=tag), TAGS),
    st.builds(
        lambda tag, **data: ResizeContainer(container_tag=tag, container_data=ResizeData(**data)),
        TAGS,
        cpu=st.sampled_from([None, 1, "50%"]),
        memory=st.sampled_from([None, 5]),
    ),
    st.builds(
        lambda c, n: components(add_nodes=AddNode(container_tag=c, node_tag=n, pkg="p", exe="e")), TAGS, NAMES
    ),
    st.builds(lambda c, n: components(remove_nodes=RemoveNode(container_tag=c, node_tag=n)), TAGS, NAMES),
    st.builds(lambda e, i: components(add_interfaces=interface(e, i)), TAGS, NAMES),
    st.builds(
        lambda e, i: components(remove_interfaces=RemoveInterface(endpoint_tag=e, interface_tag=i)),
        TAGS,
        NAMES,
    ),
    st.builds(lambda c, n: components(set_param=SetParam(container_tag=c, name=n, value=1)), TAGS, NAMES),
    st.builds(lambda c, n: components(delete_param=DeleteParam(container_tag=c, name=n)), TAGS, NAMES),
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
        CreateContainer(container_tag="c"),
        components(add_nodes=AddNode(container_tag="c", node_tag="n", pkg="p", exe="e")),
        components(add_interfaces=interface("c", "x")),
        components(add_interfaces=interface("cc", "x")),
        ConfigureConnections(connect=(Connection(tag_a="c/x", tag_b="cc/x"),)),
        ConfigureConnections(connect=(Connection(tag_a="cc/x", tag_b="robot/x"),)),
        DestroyContainer(container_tag="c"),
    ):
        desired.apply(request)
    assert not desired.nodes
    assert list(desired.interfaces) == [("cc", "x")]
    assert list(desired.connections) == [frozenset(("cc/x", "robot/x"))]


def test_undoing_disconnects_first_and_destroys_last() -> None:
    desired = Desired()
    desired.apply(CreateContainer(container_tag="c"))
    desired.apply(components(add_interfaces=interface("robot", "x")))
    desired.apply(components(add_interfaces=interface("c", "x")))
    desired.apply(ConfigureConnections(connect=(Connection(tag_a="c/x", tag_b="robot/x"),)))
    first, second, third = desired.undo()
    assert isinstance(first, ConfigureConnections)
    assert second == components(remove_interfaces=RemoveInterface(endpoint_tag="robot", interface_tag="x"))
    assert third == DestroyContainer(container_tag="c")


def test_who_is_named_first_in_a_connection_means_nothing() -> None:
    desired = Desired()
    desired.apply(ConfigureConnections(connect=(Connection(tag_a="a/x", tag_b="b/x"),)))
    desired.apply(ConfigureConnections(disconnect=(Connection(tag_a="b/x", tag_b="a/x"),)))
    assert not desired.connections


def test_a_container_is_made_again_as_it_was_and_then_resized() -> None:
    desired = Desired()
    made = CreateContainer(container_tag="a")
    desired.apply(made)
    for data in (ResizeData(cpu=1), ResizeData(memory="1G"), ResizeData(cpu="50%")):
        desired.apply(ResizeContainer(container_tag="a", container_data=data))
    resized = ResizeContainer(container_tag="a", container_data=ResizeData(cpu="50%", memory="1G"))
    assert desired.restore() == [made, resized]
