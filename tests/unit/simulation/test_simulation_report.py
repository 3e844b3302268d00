"""The simulation's report."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce_fleet.drivers.report import look_at, read_report, write_report
from rce_fleet.geometry.poses import Twist
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.world import World


def test_a_report_says_what_is_and_was(tmp_path: Path) -> None:
    world = World(GridMap())
    world.add_robot("a", 0)
    world.add_robot("b", 2)
    world.add_box(9)
    world.step(0.1)
    write_report(look_at(world), tmp_path / "r.json")
    report = read_report(tmp_path / "r.json")
    assert report is not None
    assert report.time_s == pytest.approx(0.1)
    assert report.boxes == [9]
    assert report.collisions.total == 0
    assert report.min_separation_m == pytest.approx(2 - 2 * world.spec.model.radius, abs=1e-3)
    assert (report.robot("a").cell, report.robot("b").cell) == (0, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["r.json"]
    with pytest.raises(KeyError):
        report.robot("c")


def test_separation_of_one_robot_is_none() -> None:
    world = World(GridMap())
    world.add_robot("a", 0)
    world.step(0.1)
    assert look_at(world).min_separation_m is None


def test_contacts_are_counted() -> None:
    world = World(GridMap())
    robot = world.add_robot("a", 0)
    world.add_box(1)
    for _ in range(100):
        robot.drive(Twist(0.8, 0.0))
        world.step()
    report = look_at(world)
    assert report.collisions.robot_box == report.collisions.total == 1
    assert report.robot("a").distance_m > 0.1


def test_missing_report_is_none(tmp_path: Path) -> None:
    assert read_report(tmp_path / "r.json") is None


def test_file_that_is_not_a_report_is_refused(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text("{}")
    with pytest.raises(ValueError, match="not a report"):
        read_report(tmp_path / "r.json")
