"""When a robot that is driven by hand counts as manual."""

from __future__ import annotations

from support.planner_states import robot, state

from rce_fleet.station.commands.manual_watch import SHOWN_WAIT_S, ManualWatch
from rce_fleet.station.view import FleetView


def shown(view: FleetView, mode: str, run: str = "1") -> None:
    view.on_state(state(robot("Robot1", mode=mode), started=run))


def watched(mode: str = "automatic") -> tuple[FleetView, ManualWatch]:
    """A view and a watch whose ``manual`` was accepted at 100 s."""
    view = FleetView()
    shown(view, mode)
    watch = ManualWatch(view, "Robot1")
    watch.accept(100.0)
    return view, watch


def test_the_mode_of_before_may_be_shown_for_a_while() -> None:
    """If it is shown for longer, it was set again before the view had ``manual``."""
    _, watch = watched()
    assert watch.other_mode(100.0 + SHOWN_WAIT_S) == ""
    assert watch.other_mode(100.1 + SHOWN_WAIT_S) == "automatic"


def test_any_mode_after_manual_counts() -> None:
    view, watch = watched()
    shown(view, "manual")
    assert watch.other_mode(100.0) == ""
    shown(view, "automatic")
    assert watch.other_mode(100.0) == "automatic"


def test_a_third_mode_counts_before_manual_is_shown() -> None:
    view, watch = watched()
    shown(view, "paused")
    assert watch.other_mode(100.0) == "paused"


def test_a_restarted_planner_has_set_no_other_mode() -> None:
    view, watch = watched("manual")
    shown(view, "automatic", run="2")
    assert (watch.is_forgotten, watch.other_mode(200.0)) == (True, "")
