"""What managers take from environments, which may be in the hands of their nodes."""

from __future__ import annotations

import msgspec
import pytest

from rce.control import DesiredState, ObservedStatus
from rce.control.model import (
    ConnectionSpec,
    EndpointKind,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    InterfaceUsage,
    LinkAddress,
    NodeState,
    NodeStatus,
    StatusPatch,
)
from rce.model import InterfaceSpec, NodeSpec
from rce_container import intake
from rce_container.environment import messages as m


def status(**fields: object) -> EndpointStatus:
    told = {"id": "anna/c", "revision": 3, "state": EndpointState.RUNNING, **fields}
    return intake.sanitize_status("anna/c", msgspec.convert(told, EndpointStatus), 2**53)


def test_a_sound_report_stays_as_it_is() -> None:
    said = EndpointStatus(
        id="anna/c",
        revision=3,
        state=EndpointState.DEGRADED,
        nodes=(NodeStatus(tag="n", state=NodeState.FAILED, pid=7, exit_code=-9, restarts=2, detail="why"),),
        interfaces={"i": True},
        connections=(4, 5),
    )
    assert intake.sanitize_status("anna/c", said, said.revision) == said


def test_a_container_speaks_of_itself_only() -> None:
    found = status(id="bob/c", incarnation="x", detail="y", address=LinkAddress(host="evil", port=1))
    assert found == EndpointStatus(id="anna/c", revision=3, state=EndpointState.RUNNING)
    assert status(state=EndpointState.ABSENT).state is EndpointState.RUNNING
    assert intake.sanitize_status("anna/c", status(revision=10), 4).revision == 4, "it was told of no more"


def test_sizes_are_those_of_containers() -> None:
    node = NodeStatus(tag="n", state=NodeState.FAILED, pid=10**30, exit_code=-(10**30), detail="x" * 10**6)
    found = status(
        nodes=(node, *(NodeStatus(tag=f"n{i}", state=NodeState.RUNNING) for i in range(10_000))),
        interfaces={"no name": True, **{f"i{i}": True for i in range(20_000)}},
        connections=tuple(range(100_000)),
    )
    assert len(found.nodes) == intake.MAX_ITEMS
    assert len(found.interfaces) < intake.MAX_INTERFACES
    assert "no name" not in found.interfaces
    assert len(found.connections) == intake.MAX_CONNECTIONS
    first = found.nodes[0]
    assert (first.pid, first.exit_code) == (2**53, -255)
    assert len(first.detail) < 2100
    assert len({one.tag for one in status(nodes=(node, node)).nodes}) == len(status(nodes=(node, node)).nodes)


DESIRED = DesiredState(
    EndpointSpec(
        id="anna/c",
        kind=EndpointKind.CONTAINER,
        revision=3,
        nodes=(NodeSpec(tag="n", pkg="p", exe="e"),),
        interfaces=(InterfaceSpec(tag="i", type="PublisherInterface", message_type="p/T", addr="/i"),),
        connections=(ConnectionSpec(id=4, link="l", interface="i", peer_interface="p"),),
    )
)


def hostile(part: str) -> EndpointStatus:
    """What an environment reports that nodes took over."""
    others = [
        NodeStatus(tag=f"{part}{i}", state=NodeState.FAILED, detail="\u00e9" * 4000) for i in range(5000)
    ]
    return status(
        nodes=(NodeStatus(tag="n", state=NodeState.FAILED, detail="why"), *others),
        interfaces={"i": True, **{f"{part}{'i' * 90}{i}": True for i in range(16000)}},
        connections=(4, *range(2**52, 2**52 + 60_000)),
    )


def size(said: EndpointStatus) -> int:
    return len(msgspec.json.encode(said))


def test_reports_keep_what_is_desired() -> None:
    """A report that names much more than the container has is cut down to that."""
    said = hostile("x")
    assert size(said) > 15_000_000
    found = intake.PartFilter().whole(said, DESIRED)
    assert found.interfaces == {"i": True}
    assert found.connections == (4,)
    assert size(found) < 200_000
    patch = intake.PartFilter().patch(StatusPatch(status=said), DESIRED)
    assert patch.status == found


def test_nodes_that_are_being_removed_stay() -> None:
    """A node that is removed is reported until it has ended."""
    said = status(nodes=(NodeStatus(tag="old", state=NodeState.STOPPING),))
    assert intake.PartFilter().whole(said, DESIRED) == said


@pytest.mark.slow
def test_little_is_kept_of_unknown_containers() -> None:
    """While a container's desired state is not known, patches together add no more than one report."""
    kept = intake.PartFilter()
    observed = ObservedStatus(kept.whole(hostile("x"), None))
    for number in range(5):
        observed.patch(kept.patch(StatusPatch(status=hostile(f"y{number}")), None))
    assert size(observed.whole) < 1_500_000
    usual = status(
        nodes=tuple(NodeStatus(tag=f"n{i}", state=NodeState.RUNNING, pid=i) for i in range(1000)),
        interfaces={f"interface{i}": True for i in range(10_000)},
        connections=tuple(range(5000)),
    )
    assert intake.PartFilter().whole(usual, None) == usual


def test_counters_can_be_told_on() -> None:
    said = m.Counters(
        interfaces={"i": InterfaceUsage(bytes_in=10**400, dropped=-5), "../i": InterfaceUsage()},
        traffic=(10**400, 7),
    )
    found = intake.sanitize_counters(said)
    assert found.interfaces == {"i": InterfaceUsage(bytes_in=2**53)}
    assert found.traffic == (2**53, 7)


@pytest.mark.parametrize("line", [b'{"t":"Report","x":' + b"[" * 100_000, b"\xff", b"", b'{"x":"Boo"}'])
def test_what_is_no_message_is_one_kind_of_error(line: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        intake.read(line)


def test_who_says_too_much_has_to_wait() -> None:
    now = 0.0
    pace = intake.Pace(lambda: now)
    for _ in range(100):
        pace.pay(intake.PER_FAULT)
    assert pace.pause == 0.0, "a burst is heard at once"
    for _ in range(200):
        pace.pay(intake.PER_FAULT)
    assert pace.pause == pytest.approx(5.0)
    now = 5.0
    pace.pay(0)
    assert pace.pause == 0.0
    now = 1000.0
    pace.pay(intake.BURST + intake.BYTES_PER_S)
    assert pace.pause == pytest.approx(1.0), "no more than a burst is saved up"


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        (m.StateWanted(request=1, node="n"), ""),
        (m.StateOffered(request=1, node="n", size=16 << 20), ""),
        (m.StateOffered(request=1, node="n", size=(16 << 20) + 1), "it has more than 16777216 bytes"),
        (m.StateOffered(request=1, node="n", size=-1), "it has more than 16777216 bytes"),
        (m.StateWanted(request=1, node="../n"), "it names no node"),
        (m.StateWanted(request=2**60, node="n"), "its number is too large"),
    ],
)
def test_snapshots_are_of_nodes_and_not_too_large(said: m.StateWanted | m.StateOffered, fault: str) -> None:
    assert intake.state_fault(said) == fault
