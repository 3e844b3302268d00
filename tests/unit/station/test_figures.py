"""Figures over time: what is sampled, how long it is kept, and how many points a page gets."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from support.planner_states import robot, state

from rce_fleet.station.figures import MAX_POINTS, FigureRecorder, columns_of
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.recording import FIGURES_LAST_S, Records
from rce_fleet.station.view import FleetView

STATISTICS = {"battery_mean": 0.8, "tasks_per_hour": 60.0, "tasks_open": 3, "utilization": None, "late": 0}
NOW = 1e9


class Manager:
    """Answers with statistics, or not at all."""

    answer: dict[str, Any] | None = None
    is_away = False

    async def ask(self) -> dict[str, Any] | None:
        if self.is_away:
            raise PlannerUnavailableError("away")
        return self.answer


async def test_robots_are_counted_with_and_without_a_manager() -> None:
    view, manager = FleetView(), Manager()
    with closing(Records()) as records:
        recorder = FigureRecorder(view, records, manager.ask)
        assert await recorder.sample() == {}
        view.on_state(state(robot("Robot1", state="driving"), robot("Robot2", state="waiting")))
        counted = {"moving": 1, "waiting": 1}
        assert await recorder.sample() == counted
        manager.is_away = True
        assert await recorder.sample() == counted
        manager.is_away, manager.answer = False, STATISTICS
        assert await recorder.sample() == {**counted, "battery": 0.8, "done": 60.0, "open": 3, "late": 0}


def test_figures_outlive_the_station_for_a_day(tmp_path: Path) -> None:
    records = Records(tmp_path / "history.sqlite")
    records.add_figures(NOW, {"moving": 1})
    records.add_figures(NOW + FIGURES_LAST_S - 1, {"moving": 2})
    records.close()
    later = Records(tmp_path / "history.sqlite")
    assert [figures["moving"] for _, figures in later.figures(0.0)] == [1, 2]
    later.add_figures(NOW + FIGURES_LAST_S + 1, {"moving": 3})
    assert [figures["moving"] for _, figures in later.figures(0.0)] == [2, 3]
    assert later.figures(NOW + FIGURES_LAST_S) == [(NOW + FIGURES_LAST_S + 1, {"moving": 3})]
    later.close()


def test_a_day_is_thinned_and_ends_with_the_newest() -> None:
    samples = [(NOW + 5 * n, {"moving": float(n), **({"late": 0.0} if n else {})}) for n in range(17_280)]
    times, figures = columns_of(samples)
    assert len(times) <= MAX_POINTS
    assert (times[-1], figures["moving"][-1]) == (NOW + 5 * 17_279, 17_279.0)
    assert columns_of(samples[:2]) == ([NOW, NOW + 5], {"late": [None, 0.0], "moving": [0.0, 1.0]})
    assert columns_of([]) == ([], {})
