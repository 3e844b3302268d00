"""What the manager decides."""

from __future__ import annotations

from typing import TypeVar

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from rce.control.messages import Fault, Gone, PatchStatus, SpecWanted, Status
from rce.control.model import (
    EndpointKind,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    LinkAddress,
    SpecPatch,
    StatusPatch,
)
from rce.model.specs import InterfaceSpec
from rce_container import core, events
from rce_container.core import ManagerCore
from rce_container.life import CONTAINER_LIFE, Phase

T = TypeVar("T")

ID = "user/box"
ADDRESS = LinkAddress(machine="m", unix="/run/x")


def spec(revision: int = 1, id_: str = ID) -> EndpointSpec:
    return EndpointSpec(id=id_, kind=EndpointKind.CONTAINER, revision=revision)


def status(revision: int = 1, id_: str = ID) -> EndpointStatus:
    return EndpointStatus(id=id_, revision=revision, state=EndpointState.RUNNING)


def running(incarnation_id: str = "one", revision: int = 1) -> ManagerCore:
    manager = ManagerCore()
    manager.handle(events.Put(spec(revision)), 0.0)
    manager.handle(events.Made(ID, incarnation_id, ADDRESS), 0.0)
    manager.handle(events.Reported(ID, incarnation_id, status(revision)), 0.0)
    return manager


def told(out: list[events.Instruction], kind: type[T]) -> list[T]:
    return [one.message for one in out if isinstance(one, events.Tell) and isinstance(one.message, kind)]


def test_put_starts_a_container_and_gives_it_its_spec() -> None:
    manager = ManagerCore()
    assert manager.handle(events.Put(spec()), 0.0) == [events.Start(ID)]
    out = manager.handle(events.Made(ID, "one", ADDRESS), 0.0)
    assert out[0] == events.Apply(ID, "one", spec())
    assert told(out, Status)[0].status.state is EndpointState.STARTING
    out = manager.handle(events.Reported(ID, "one", status()), 0.1)
    reported = told(out, Status)[0].status
    assert (reported.state, reported.incarnation, reported.address) == (EndpointState.RUNNING, "one", ADDRESS)


def test_put_of_an_older_revision_is_ignored() -> None:
    manager = running(revision=5)
    assert manager.handle(events.Put(spec(4)), 1.0) == []
    assert manager.handle(events.Put(spec(6)), 1.0) == [events.Apply(ID, "one", spec(6))]


def test_drop_stops_and_says_gone_when_nothing_is_left() -> None:
    manager = running()
    out = manager.handle(events.Drop(ID, 7, "destroyed"), 1.0)
    assert events.Stop(ID, "one", "destroyed") in out
    assert told(out, Status)[0].status.state is EndpointState.STOPPING
    assert not told(out, Gone)
    manager.handle(events.Lost(ID, "one", "its environment ended"), 1.1)
    out = manager.handle(events.Removed(ID, "one"), 1.2)
    assert told(out, Gone) == [Gone(id=ID, revision=7)]
    assert not told(out, Fault)
    assert not manager.containers


def test_drop_of_what_continues_elsewhere_saves_its_states() -> None:
    out = running().handle(events.Drop(ID, 7, "it moves", elsewhere=True), 1.0)
    assert events.Stop(ID, "one", "it moves", saves_states=True) in out


def test_drop_of_what_is_not_there_says_gone_at_once() -> None:
    assert told(ManagerCore().handle(events.Drop(ID, 3), 0.0), Gone) == [Gone(id=ID, revision=3)]


def test_put_while_it_stops_starts_it_anew_and_never_says_gone() -> None:
    manager = running()
    manager.handle(events.Drop(ID, 7), 1.0)
    assert manager.handle(events.Put(spec(8)), 1.1) == []
    out = manager.handle(events.Removed(ID, "one"), 1.2)
    assert out == [events.Start(ID)]


def test_unexpected_end_is_repaired_with_growing_pauses() -> None:
    """An unexpected end is told and mended with growing pauses."""
    manager = running()
    pauses = []
    faults = []
    for number, incarnation_id in enumerate(("one", "two", "three", "four")):
        out = manager.handle(events.Lost(ID, incarnation_id, "killed"), number + 1.0)
        faults += told(out, Fault)
        assert told(out, Status)[-1].status.state is EndpointState.FAILED
        out = manager.handle(events.Removed(ID, incarnation_id), number + 1.0)
        (wait,) = (one for one in out if isinstance(one, events.Wait))
        pauses.append(wait.delay)
        assert manager.handle(events.Due(ID, wait.ticket - 1), 2.0) == []
        assert manager.handle(events.Due(ID, wait.ticket), 2.0) == [events.Start(ID)]
        following = ("one", "two", "three", "four", "five")[number + 1]
        manager.handle(events.Made(ID, following, ADDRESS), 2.0)
        manager.handle(events.Reported(ID, following, status()), 2.0)
    assert pauses == [0.0, 0.5, 1.0, 2.0]
    assert len(faults) == 1, "the user hears of the same failure once"
    assert "killed" in faults[0].text


def test_a_stable_container_is_mended_at_once_again() -> None:
    manager = running()
    for incarnation_id, now in (("one", 1.0), ("two", 2.0 + core.STABLE_S)):
        manager.handle(events.Lost(ID, incarnation_id, "killed"), now)
        out = manager.handle(events.Removed(ID, incarnation_id), now)
        (wait,) = (one for one in out if isinstance(one, events.Wait))
        assert wait.delay == 0.0
        manager.handle(events.Due(ID, wait.ticket), now)
        manager.handle(events.Made(ID, "two", ADDRESS), now)
        manager.handle(events.Reported(ID, "two", status()), now)


def test_a_container_that_cannot_be_started_is_tried_again() -> None:
    manager = ManagerCore()
    manager.handle(events.Put(spec()), 0.0)
    out = manager.handle(events.Lost(ID, "", "the disk is full"), 0.0)
    assert "the disk is full" in told(out, Fault)[0].text
    assert any(isinstance(one, events.Wait) for one in out)
    assert manager.containers[ID].phase is Phase.WAITING


def test_events_of_an_older_life_are_ignored() -> None:
    manager = running("two")
    before = manager.statuses
    for event in (
        events.Reported(ID, "one", status(9)),
        events.Lost(ID, "one", "killed"),
        events.Removed(ID, "one"),
        events.Faulted(ID, "one", "x"),
    ):
        assert manager.handle(event, 1.0) == []
    assert manager.statuses == before


def test_sync_removes_what_is_not_desired_and_keeps_adopted_ones() -> None:
    manager = ManagerCore()
    for tag in ("kept", "other"):
        manager.handle(events.Adopted(tag, status(4, f"user/{tag}"), ADDRESS), 0.0)
    out = manager.handle(events.Sync((spec(5, "user/kept"), spec(1, "user/new"))), 1.0)
    assert events.Stop("user/other", "other", "it is not desired here any more") in out
    assert events.Apply("user/kept", "kept", spec(5, "user/kept")) in out
    assert events.Start("user/new") in out
    out = manager.handle(events.Removed("user/other", "other"), 1.0)
    assert told(out, Gone) == [Gone(id="user/other", revision=4)]


def test_a_container_is_degraded_while_a_node_is_not_well() -> None:
    manager = running()
    ill = msgspec.structs.replace(status(), state=EndpointState.DEGRADED)
    (reported,) = told(manager.handle(events.Reported(ID, "one", ill), 1.0), Status)
    assert reported.status.state is EndpointState.DEGRADED
    assert manager.containers[ID].phase is Phase.DEGRADED
    assert manager.handle(events.Put(spec(2)), 1.5) == [events.Apply(ID, "one", spec(2))]
    (reported,) = told(manager.handle(events.Reported(ID, "one", status()), 2.0), Status)
    assert reported.status.state is EndpointState.RUNNING
    manager.handle(events.Reported(ID, "one", ill), 3.0)
    out = manager.handle(events.Drop(ID, 9), 4.0)
    assert events.Stop(ID, "one") in out
    adopting = ManagerCore()
    adopting.handle(events.Adopted("one", ill, ADDRESS), 0.0)
    assert adopting.statuses[0].state is EndpointState.DEGRADED


def test_quit_stops_all_starts_nothing_and_drops_nothing() -> None:
    manager = running()
    assert events.Stop(ID, "one", "its manager was told to end") in manager.handle(events.Quit(), 1.0)
    assert manager.handle(events.Put(spec(9)), 1.0) == []
    assert told(manager.handle(events.Removed(ID, "one"), 1.0), Gone) == []
    assert not manager.containers


def test_every_phase_can_end() -> None:
    """From every phase there is a way to nothing being left."""
    for phase in Phase:
        reached, edge = {phase}, [phase]
        while edge:
            new = {after for after in CONTAINER_LIFE.table[edge.pop()].values() if after not in reached}
            reached |= new
            edge += new
        assert Phase.GONE in reached


EVENTS = st.one_of(
    st.builds(lambda r: ("put", r), st.integers(1, 5)),
    st.sampled_from(
        [("drop", 9), ("sync", 0), ("sync", 3), ("report", 0), ("ill", 0), ("lost", 0), ("removed", 0)]
    ),
    st.sampled_from([("due", 0), ("fail", 0)]),
)


@given(st.lists(EVENTS, max_size=40))
def test_any_order_of_events_keeps_the_invariants(  # noqa: C901, PLR0912 - a small machine of its own
    steps: list[tuple[str, int]],
) -> None:
    """A machine that answers every instruction at some time, in the order in which hypothesis likes it."""
    manager = ManagerCore()
    alive: str | None = None
    ended = False
    tickets: list[int] = []
    for now, (name, number) in enumerate(steps):
        event: events.Event
        match name:
            case "put":
                event = events.Put(spec(number))
            case "drop":
                event = events.Drop(ID, number)
            case "sync":
                event = events.Sync((spec(number),) if number else ())
            case "report" | "ill" if alive and not ended:
                state = EndpointState.RUNNING if name == "report" else EndpointState.DEGRADED
                event = events.Reported(ID, alive, msgspec.structs.replace(status(), state=state))
            case "lost" if alive and not ended:
                event, ended = events.Lost(ID, alive, "killed"), True
            case "removed" if alive and ended:
                event, alive = events.Removed(ID, alive), None
            case "due" if tickets:
                event = events.Due(ID, tickets.pop())
            case _:
                continue
        out = manager.handle(event, float(now))
        while out:
            one = out.pop(0)
            if isinstance(one, events.Start):
                assert alive is None, "two lives at once"
                if name == "due" and number:
                    out += manager.handle(events.Lost(ID, "", "no"), float(now))
                else:
                    alive, ended = f"life {now}", False
                    out += manager.handle(events.Made(ID, alive, ADDRESS), float(now))
            elif isinstance(one, events.Wait):
                tickets.append(one.ticket)
        manager.validate()


def patch(base: int, revision: int, **parts: object) -> SpecPatch:
    return SpecPatch(id=ID, base=base, revision=revision, **parts)  # type: ignore[arg-type]  # any of its fields


INTERFACE = InterfaceSpec(tag="i", type="PublisherInterface", message_type="p/T", addr="/i")


def test_a_patch_goes_on_to_the_environment() -> None:
    manager = running(revision=5)
    one = patch(5, 6, interfaces=(INTERFACE,))
    assert manager.handle(events.Patch(one), 1.0) == [events.ApplyPatch(ID, "one", one)]
    assert manager.handle(events.Patch(one), 1.0) == [], "it is known already"
    out = manager.handle(events.Patch(patch(7, 8)), 1.0)
    assert told(out, SpecWanted) == [SpecWanted(id=ID)]
    assert manager.handle(events.Put(spec(8)), 1.0) == [events.Apply(ID, "one", spec(8))]


def test_a_patch_of_what_is_not_there_asks_for_the_whole() -> None:
    out = ManagerCore().handle(events.Patch(patch(1, 2)), 0.0)
    assert out == [events.Tell(SpecWanted(id=ID))]
    manager = ManagerCore()
    manager.handle(events.Adopted("one", status(4), ADDRESS), 0.0)
    assert told(manager.handle(events.Patch(patch(4, 5)), 1.0), SpecWanted)


def test_a_life_that_begins_gets_the_whole_with_all_patches() -> None:
    manager = ManagerCore()
    manager.handle(events.Put(spec(1)), 0.0)
    assert manager.handle(events.Patch(patch(1, 2, interfaces=(INTERFACE,))), 0.0) == []
    out = manager.handle(events.Made(ID, "one", ADDRESS), 0.0)
    assert out[0] == events.Apply(ID, "one", msgspec.structs.replace(spec(2), interfaces=(INTERFACE,)))


def test_reports_are_numbered_and_changes_are_told_as_changes() -> None:
    manager = running()
    before = manager.statuses[0].number
    said = msgspec.structs.replace(status(2), interfaces={"i": True}, connections=(7,))
    out = manager.handle(events.Changed(ID, "one", StatusPatch(status=said)), 1.0)
    (change,) = told(out, PatchStatus)
    assert change.patch.status.number == before + 1
    assert (change.patch.status.incarnation, change.patch.status.address) == ("one", ADDRESS)
    assert change.patch.status.interfaces == {"i": True}
    assert manager.statuses[0].interfaces == {"i": True}
    assert manager.statuses[0].number == before + 1
    (whole,) = told(manager.handle(events.StatusWanted(ID), 1.0), Status)
    assert (whole.status.number, whole.status.connections) == (before + 2, (7,))
    assert manager.handle(events.StatusWanted("user/none"), 1.0) == []


def test_changes_before_a_report_or_of_another_life_are_ignored() -> None:
    manager = ManagerCore()
    manager.handle(events.Put(spec()), 0.0)
    manager.handle(events.Made(ID, "one", ADDRESS), 0.0)
    change = StatusPatch(status=msgspec.structs.replace(status(), interfaces={"i": True}))
    assert manager.handle(events.Changed(ID, "one", change), 0.0) == []
    manager = running()
    assert manager.handle(events.Changed(ID, "two", change), 0.0) == []
