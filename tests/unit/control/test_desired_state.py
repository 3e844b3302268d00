"""Patches that come late, twice, in another order or not at all: in the end there is what is desired."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from support.patches import in_order, patch_between

from rce.control.desired import DesiredState, Difference, Fit
from rce.control.model import (
    ConnectionSpec,
    EndpointKind,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    LinkSpec,
    SpecPatch,
    StatusPatch,
)
from rce.control.observed import ObservedStatus
from rce.model.specs import InterfaceSpec, NodeSpec

ID = "anna/c"
TAGS, LINKS, NUMBERS = ["i", "j", "k"], ["l1", "l2"], [1, 2, 3, 4]
INTERFACES = st.dictionaries(st.sampled_from(TAGS), st.sampled_from(["p/A", "p/B"]))
LINKED = st.dictionaries(st.sampled_from(LINKS), st.sampled_from(["anna/r", ID]))
CONNECTED = st.dictionaries(
    st.sampled_from(NUMBERS), st.tuples(st.sampled_from(LINKS), st.sampled_from(TAGS), st.sampled_from(TAGS))
)
NODES = st.sampled_from([(), (NodeSpec(tag="n", pkg="p", exe="e"),)])


def spec(
    revision: int,
    interfaces: dict[str, str],
    links: dict[str, str],
    connections: dict[int, tuple[str, str, str]],
    nodes: tuple[NodeSpec, ...],
) -> EndpointSpec:
    return EndpointSpec(
        id=ID,
        kind=EndpointKind.CONTAINER,
        revision=revision,
        interfaces=tuple(
            InterfaceSpec(tag=tag, type="PublisherInterface", message_type=type_, addr="/x")
            for tag, type_ in sorted(interfaces.items())
        ),
        links=tuple(
            LinkSpec(id=id_, peer=peer, token="t", dial=False) for id_, peer in sorted(links.items())
        ),
        connections=tuple(
            ConnectionSpec(id=number, link=link, interface=one, peer_interface=other)
            for number, (link, one, other) in sorted(connections.items())
        ),
        nodes=nodes,
    )


def check_indexes(state: DesiredState) -> None:
    again = DesiredState(state.whole)
    for tag in TAGS:
        assert set(state.connections_at(tag)) >= {
            one.id for one in state.connections.values() if one.interface == tag
        }
    for link in LINKS:
        assert set(state.connections_on(link)) == set(again.connections_on(link))


Parts = tuple[dict[str, str], dict[str, str], dict[int, tuple[str, str, str]], tuple[NodeSpec, ...]]
PARTS = st.tuples(INTERFACES, LINKED, CONNECTED, NODES)
HISTORIES = st.lists(PARTS, min_size=1, max_size=8)


class Receiver:
    """Takes what comes over a way on which messages are lost, doubled and reordered, as the fates say."""

    def __init__(self, first: EndpointSpec, fates: list[int]) -> None:
        self.state = DesiredState(first)
        self.newest = first
        self.fates = fates
        self.waiting: list[SpecPatch | EndpointSpec] = []

    def send(self, message: SpecPatch | EndpointSpec) -> None:
        fate = self.fates.pop() if self.fates else 0
        if fate == 1:
            return
        self.waiting.insert(0 if fate == 2 else len(self.waiting), message)
        if fate == 3:
            self.waiting.append(message)

    def change(self, spec: EndpointSpec) -> None:
        patch = patch_between(self.newest, spec)
        self.newest = spec
        self.send(patch)

    def take(self, count: int) -> None:
        for _ in range(count):
            if not self.waiting:
                return
            message = self.waiting.pop(0)
            if isinstance(message, SpecPatch):
                self.take_patch(message)
            elif message.revision >= self.state.revision:
                self.state.replace(message)
            check_indexes(self.state)

    def take_patch(self, patch: SpecPatch) -> None:
        fit = self.state.fit(patch)
        if fit is Fit.NEXT:
            self.state.patch(patch)
        elif fit is Fit.GAP:
            self.send(self.newest)


@given(history=HISTORIES, fates=st.lists(st.integers(0, 3)), steps=st.lists(st.integers(0, 3)))
@settings(deadline=None)
def test_patches_under_loss_and_reordering_reach_the_newest_spec(
    history: list[Parts], fates: list[int], steps: list[int]
) -> None:
    specs = {10 * number: spec(10 * number, *parts) for number, parts in enumerate(history, 1)}
    receiver = Receiver(specs[10], fates)
    for one in list(specs.values())[1:]:
        receiver.change(one)
        receiver.take(steps.pop() if steps else 1)
        state = receiver.state
        assert in_order(state.whole) == specs[state.revision], "never a mixture of two"
    receiver.fates = []
    last = replace(receiver.newest, revision=receiver.newest.revision + 10)
    receiver.change(last)  # what comes after a gap finds it
    while receiver.waiting:
        receiver.take(1)
    assert in_order(receiver.state.whole) == last


@given(one=PARTS, other=PARTS)
def test_whole_specs_and_patches_tell_the_same_difference(one: Parts, other: Parts) -> None:
    before, after = spec(1, *one), spec(2, *other)
    patched, replaced = DesiredState(before), DesiredState(before)
    by_patch = patched.patch(patch_between(before, after))
    by_whole = replaced.replace(after)
    assert set(by_patch.interfaces) == set(by_whole.interfaces)
    assert set(by_patch.links) == set(by_whole.links)
    assert set(by_patch.connections) == set(by_whole.connections)
    assert by_patch.contents == by_whole.contents
    assert replaced.replace(after) == Difference()


def status(number: int, **fields: object) -> EndpointStatus:
    return EndpointStatus(id=ID, revision=1, state=EndpointState.RUNNING, number=number, **fields)  # type: ignore[arg-type]  # any of its fields


def test_status_patches_add_up() -> None:
    observed = ObservedStatus(status(1, interfaces={"i": False, "j": True}, connections=(1, 2)))
    observed.patch(
        StatusPatch(
            status=status(2, interfaces={"i": True}, connections=(3,)),
            removed_interfaces=("j",),
            lost_connections=(1,),
        )
    )
    assert observed.whole == status(2, interfaces={"i": True}, connections=(2, 3))


def test_no_more_parts_are_kept_than_allowed() -> None:
    observed = ObservedStatus(status(1, interfaces={"i": True}), max_parts=2)
    observed.patch(StatusPatch(status=status(2, interfaces={"j": True, "k": True}, connections=(1, 2, 3))))
    observed.patch(StatusPatch(status=status(3, interfaces={"i": False})))
    assert observed.whole.interfaces == {"i": False, "j": True}
    assert observed.whole.connections == (1, 2)
