"""The planner's parameters: bad ones are named, unknown ones are noted."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import rce_fleet
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.exceptions import LanesError, PlannerError
from rce_fleet.nodes.grid_choice import CHOSEN
from rce_fleet.nodes.grid_parameters import make_grid, unknown_parameters
from rce_fleet.nodes.planner_parameters import IMPROVE_SECONDS, KNOWN, read_lane_graph, read_settings
from rce_fleet.planning.grid import GridMap

README = Path(rce_fleet.__file__).parent / "share" / "README.md"


def test_defaults_are_the_settings() -> None:
    default = FleetSettings(improve_seconds=IMPROVE_SECONDS)
    assert read_settings({}) == default
    assert read_settings({"robot_radius": 1, "seed": 3.0}) == replace(default, robot_radius=1.0, seed=3)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"robot_radius": "wide"}, "parameter robot_radius must be a number, not 'wide'"),
        ({"robot_radius": -0.2}, "parameter robot_radius must be above 0, not -0.2"),
        ({"robot_radius": float("nan")}, "parameter robot_radius must be a number, not nan"),
        ({"seed": 0.5}, "parameter seed must be a whole number, not 0.5"),
        ({"seed": True}, "parameter seed must be a number, not True"),
        ({"quarter_turn": -1}, "-1"),
        ({"improve_seconds": -1}, "parameter improve_seconds must be 0 or more, not -1"),
        ({"sensed_lifetime": -1}, "parameter sensed_lifetime must be 0 or more, not -1"),
    ],
)
def test_settings_that_cannot_be_used_are_named(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        read_settings(values)


def test_unknown_planner_is_refused() -> None:
    with pytest.raises(PlannerError, match=r"parameter planner is 'lacom'; installed planners are .*lacam"):
        read_settings({"planner": "lacom"})


def test_lanes_need_the_width_of_the_robots(tmp_path: Path) -> None:
    file = tmp_path / "lanes.yaml"
    file.write_text("lanes: [{name: a, path: [0, 2], width: 0.5}, {name: b, path: [8, 9]}]")
    assert read_lane_graph({}, GridMap(), 0.22) == (None, [])
    lanes, remarks = read_lane_graph({"lanes": str(file)}, GridMap(), 0.25)
    assert lanes is not None
    assert ([lane.name for lane in lanes.lanes], remarks) == (["a", "b"], [])
    lanes, remarks = read_lane_graph({"lanes": str(file)}, GridMap(), 0.26)
    assert lanes is not None
    assert [lane.name for lane in lanes.lanes] == ["b"]
    text = f"{file}: lane 'a' is 0.5 m wide, and robots with a radius of 0.26 m need 0.52 m: it is not used"
    assert remarks == [text]
    file.write_text("lanes: [{name: a, path: [0, 2], width: 0.5}]")
    with pytest.raises(LanesError, match=re.escape(f"{text}; no lane is left")):
        read_lane_graph({"lanes": str(file)}, GridMap(), 0.26)


@pytest.mark.parametrize(
    "given",
    [
        "lanes:\n  - {name: a, path: [0, 2]}\n",
        '{"lanes": [{"name": "a", "path": [0, 2]}]}',
        {"lanes": [{"name": "a", "path": [0, 2]}]},
    ],
    ids=["yaml", "json", "mapping"],
)
def test_lanes_may_be_given_without_a_file(given: object) -> None:
    lanes, remarks = read_lane_graph({"lanes": given}, GridMap(), 0.22)
    assert lanes is not None
    assert ([lane.cells for lane in lanes.lanes], remarks) == ([(0, 1, 2)], [])


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("lanes:\n  - path: [0, 9]\n", "the parameter lanes: lanes[0].path[1]: cell 9 is neither"),
        ("{lanes: [", "the parameter lanes, line 1: not YAML or JSON"),
        ({"lane": []}, "the parameter lanes: the file: unknown key 'lane'"),
        ([0, 2], "the parameter lanes: the file: expected keys and values, found [0, 2]"),
        ({}, "the parameter lanes: lanes: expected a list of lanes"),
        ([], "the parameter lanes: the file: expected keys and values, found []"),
        (False, "the parameter lanes: the file: expected keys and values, found False"),
    ],
)
def test_bad_lanes_without_a_file_are_named(given: object, text: str) -> None:
    with pytest.raises(LanesError, match=re.escape(text)):
        read_lane_graph({"lanes": given}, GridMap(), 0.22)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"rows": -2}, "at least one row and one column, not -2 x 8"),
        ({"rows": "eight"}, "parameter rows must be a number, not 'eight'"),
        ({"walls": 9}, "parameter walls must be a list of cells, such as [9, 20], not 9"),
        ({"walls": [1.5]}, "parameter walls must be a list of cells"),
        ({"cell_size": [1]}, "parameter cell_size must be a number, not [1]"),
    ],
)
def test_grids_that_cannot_be_made_are_named(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        make_grid(values)


def test_unknown_parameters_are_noted_with_the_nearest_known_one() -> None:
    assert unknown_parameters(["rows", "wals"], KNOWN) == ["unknown parameter wals; did you mean walls?"]


def test_the_documented_parameters_are_the_known_ones() -> None:
    table = README.read_text().partition("## Parameters of the planner")[2].partition("\n## ")[0]
    names = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert {name for cell in names for name in re.findall(r"`(\w+)`", cell)} == KNOWN - {CHOSEN}
