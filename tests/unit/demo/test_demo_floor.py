"""The demo's floor: no symmetry, connected cells, and the same wherever it is described."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.floor import FLOOR
from rce_fleet.demo.resources import Ports
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.drivers.scene import load_scene
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.lidar import Floats, LidarSpec, cast_many
from rce_fleet.simulation.walls import Walls

SHIPPED = Path(__file__).parents[3] / "configs" / "scene.yaml"
SENSOR = LidarSpec(beams=360, max_range=8.0)
LOOKS_ALIKE = 0.1
"""Metres between two ranges that a filter cannot tell apart."""


def moved(points: Floats, turns: int, mirrored: bool) -> Floats:
    """Points of the floor mirrored and turned around its middle."""
    around = points - 4.0
    if mirrored:
        around = around * np.array((-1.0, 1.0))
    for _ in range(turns):
        around = np.stack((-around[:, 1], around[:, 0]), axis=1)
    return around + 4.0


def ends_of_beams(walls: Walls, places: Floats) -> tuple[Floats, Floats]:
    """Ranges from places, shape (N, beams), and the directions of the beams, shape (beams, 2)."""
    poses = np.column_stack((places, np.zeros(len(places))))
    angles = SENSOR.angles()
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return cast_many(SENSOR, poses, walls.edges(glass=False), np.empty((0, 3))), directions


@pytest.mark.parametrize(
    ("turns", "mirrored"), [(1, False), (2, False), (3, False), *((turns, True) for turns in range(4))]
)
def test_the_floor_has_no_symmetry(turns: int, mirrored: bool) -> None:
    """Seen from the place that a symmetry would map it to, each cell looks different by far."""
    walls = load_scene(SHIPPED).floor().walls
    cells = np.array([FLOOR.centre(cell) for cell in FLOOR.free])
    images = moved(cells, turns, mirrored)
    kept = np.array([FLOOR.cell_at(*image) not in FLOOR.blocked for image in images])
    ranges, directions = ends_of_beams(walls, cells[kept])
    turned = moved(directions + 4.0, turns, mirrored) - 4.0
    beams = np.round((np.arctan2(turned[:, 1], turned[:, 0]) + np.pi) / SENSOR.increment).astype(int) % 360
    seen, _ = ends_of_beams(walls, images[kept])
    different = np.abs(ranges - seen[:, beams]) > LOOKS_ALIKE
    assert different.mean() > 0.35, "of all beams"
    assert different.mean(axis=1).min() > 0.05, "from each cell"


def test_all_cells_are_connected_with_a_few_boxes() -> None:
    assert (FLOOR.rows, FLOOR.columns) == (8, 8)
    assert FLOOR.connected()
    for seed in range(5):
        scenario = choose_scenario(8, seed)
        grid = FLOOR.with_blocked(FLOOR.blocked | scenario.boxes)
        assert grid.connected()


def test_the_demos_world_is_the_shipped_scene(tmp_path: Path) -> None:
    config = DemoConfig(choose_scenario(3, 0), 0, Ports(), tmp_path)
    config.write_scene()
    demo, shipped = load_scene(config.scene), load_scene(SHIPPED)
    one, other = demo.floor(), shipped.floor()
    assert one.grid == other.grid
    for glass in (False, True):
        np.testing.assert_allclose(one.walls.edges(glass=glass), other.walls.edges(glass=glass))
    assert [door.spec() for door in demo.doors] == [door.spec() for door in shipped.doors]


def test_robots_fit_into_alcove_and_door() -> None:
    world = load_scene(SHIPPED).build()
    for x, y in ((-0.35, 5.5), (6.5, 2.5), (6.5, 1.7)):
        assert not world.is_solid(x, y, 0.22), (x, y)
        world.move_robot("Robot1", Pose(x, y, 0.0))
    world.doors["door"].wanted = False
    world.move_robot("Robot1", Pose(2.5, 2.5, 0.0))
    world.step(3.0)
    assert world.is_solid(6.5, 2.0, 0.22)
