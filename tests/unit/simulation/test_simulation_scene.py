"""The simulation's scene file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rce.config.exceptions import ConfigError
from rce_fleet.drivers.scene import load_scene, scene_of
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import make_scenario

ROBOT = {"id": "Robot1", "cell": 3}


def load(folder: Path, **scene: object) -> Any:
    (folder / "scene.json").write_text(json.dumps(scene))
    return load_scene(folder / "scene.json")


def test_a_scenario_goes_through_a_file(tmp_path: Path) -> None:
    scenario = make_scenario(GridMap(blocked=frozenset({0, 9})), 3, seed=4)
    scene = scene_of(scenario, 4)
    (tmp_path / "scene.json").write_text(scene.model_dump_json())
    assert load_scene(tmp_path / "scene.json") == scene
    assert scene.grid == scenario.grid


def test_the_world_is_as_the_scene_says() -> None:
    scenario = make_scenario(GridMap(blocked=frozenset({0, 9})), 3, seed=4)
    world = scene_of(scenario).build()
    assert world.boxes == tuple(sorted(scenario.boxes))
    for robot, start, heading in zip(scenario.robots, scenario.starts, scenario.headings, strict=True):
        pose = world.robots[robot].pose
        assert world.grid.cell_at(pose.x, pose.y) == start
        assert abs(pose.yaw) == pytest.approx(abs(heading))


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ({"robots": [{"id": "Robot1", "cell": 64}]}, r"cells \[64\] are not on the map"),
        ({"boxes": [-1]}, r"cells \[-1\]"),
        ({"robots": [ROBOT, {"id": "Robot2", "cell": 3}]}, "same id or the same cell"),
        ({"robots": [ROBOT, {"id": "Robot1", "cell": 4}]}, "same id or the same cell"),
        ({"robots": [ROBOT], "walls": [3]}, r"blocked cells \[3\]"),
        ({"robots": [{"id": "no name", "cell": 1}]}, r"robots\[0\].id"),
        ({"rows": 0}, "rows"),
        ({"rows": 10_000, "columns": 10_000}, "more than"),
        ({"colour": "red"}, "colour"),
        ({"boxes": [{"id": "cell_3", "at": [1.5, 1.5]}]}, "cell_3: boxes in cells have such ids"),
    ],
)
def test_a_bad_scene_is_refused(tmp_path: Path, scene: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load(tmp_path, **scene)
