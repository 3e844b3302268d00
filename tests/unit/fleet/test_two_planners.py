"""Two planners that drive the same robots in two ROS graphs; and planners that are only restarted."""

from __future__ import annotations

import pytest

from rce_fleet.coordination.answers import (
    Answer,
    answer_array,
    is_answer,
    numbered_array,
    planner_of,
    read_answer,
    revision_of,
)
from rce_fleet.coordination.events import PoseSeen, ReportSeen, Tick
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import EARLIER_LIST, FOREIGN_LIST, FleetPlanner
from rce_fleet.coordination.planner_watch import WITHIN_S, OtherPlanner, PlannerWatch
from rce_fleet.planning.grid import GridMap

OLD, NEW, NEWEST = "1700000100.000000000", "1700000200.000000000", "1700000200.000000001"


def found(watch: PlannerWatch, *names: str, every: float = 5.0) -> list[OtherPlanner | None]:
    """Let Robot1 report the planners with these names, one after the other."""
    return [watch.take("Robot1", name, every * number) for number, name in enumerate(names)]


@pytest.mark.parametrize(("own", "other"), [(OLD, NEW), (NEW, OLD), (NEW, NEWEST)])
def test_another_planner_is_found_when_it_comes_again(own: str, other: str) -> None:
    """Each of them gives the robot its grid again after the other has: the older one has to stop."""
    watch = PlannerWatch(own)
    told = OtherPlanner("Robot1", other, is_newer=other > own)
    assert found(watch, own, own, other, other, own) == [None] * 5
    assert watch.take("Robot2", own, 25.0) is watch.take("Robot2", other, 25.0) is None
    assert watch.take("Robot1", other, 25.0) == told
    assert watch.is_with_other("Robot1")
    assert not watch.is_with_other("Robot3")


@pytest.mark.parametrize("before", [OLD, NEWEST], ids=["clock forward", "clock back"])
def test_a_restarted_planner_finds_no_other_one(before: str) -> None:
    """The robot reports the planner before it; one of its messages comes late."""
    watch = PlannerWatch(NEW)
    assert found(watch, before, before, NEW, NEW, before, NEW, NEW) == [None] * 7


def test_a_planner_is_not_another_one_than_itself() -> None:
    """Another grid gives it another name; move clients with a grid of their own report none."""
    watch = PlannerWatch(OLD)
    watch.rename(NEW)
    assert found(watch, OLD, NEW, OLD, NEW, "", NEW, "0.000000000", OLD, "?", NEW) == [None] * 10


def test_a_change_long_ago_does_not_count() -> None:
    assert found(PlannerWatch(OLD), OLD, NEW, OLD, NEW, every=WITHIN_S) == [None] * 4


def test_answers_say_whose_list_was_taken() -> None:
    """Programs of earlier releases read lists and answers with the name of a planner as before."""
    dimensions = numbered_array((1, 2), 17, planner=NEW)["layout"]["dim"]
    labels = [dimension["label"] for dimension in dimensions]
    assert (revision_of(labels), planner_of(labels), is_answer(labels)) == (17, NEW, False)
    assert planner_of(["revision=17"]) == ""
    for planner in (NEW, ""):
        given = Answer(ClientReport(17, ClientState.DRIVING, (1, 2), 1, 2), (5,), planner=planner)
        fields = answer_array(given)
        labels, sizes = ([one[key] for one in fields["layout"]["dim"]] for key in ("label", "size"))
        assert read_answer(labels, sizes, fields["data"]) == given


def test_a_list_of_another_program_is_named_as_such() -> None:
    """The first report after a start may be of the planner before; after this one's list it is not."""
    planner = FleetPlanner(GridMap(3, 3))

    def report(revision: int, now: float) -> str:
        planner.handle(PoseSeen("Robot1", 0.5, 0.5, 0.0), now)
        planner.handle(ReportSeen("Robot1", ClientReport(revision, ClientState.IDLE)), now)
        planner.handle(Tick(), now)
        return planner.state.robots["Robot1"].reason

    assert report(50, 0.0) == EARLIER_LIST
    for now in (0.5, 1.0, 1.5):
        reason = report(planner.state.robots["Robot1"].revision, now)
    assert reason == ""
    assert report(planner.state.robots["Robot1"].revision + 1, 2.0) == FOREIGN_LIST
