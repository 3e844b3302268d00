"""Scenes with walls, maps, doors, walkers and robot models; and what is said of bad ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rce.config.exceptions import ConfigError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.drivers.robot_models import load_model, shipped_models
from rce_fleet.drivers.scene import load_scene
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.fleet_grid import fleet_grid
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import load_map, save_map
from rce_fleet.simulation.map_walls import draw_map, walls_of_map
from rce_fleet.simulation.world import World
from rce_fleet.wiring import FLOOR_PARAMETERS

CONFIGS = Path(__file__).parents[3] / "configs"

FULL = """
rows: 6
columns: 10
walls:
  - 12
  - {line: [[3, 0], [3, 2.5]], thickness: 0.1}
  - {line: [[6, 3], [8, 3], [8, 5]], glass: true}
  - {at: [1, 4], size: [0.8, 0.4], yaw: 0.5}
boxes:
  - 30
  - {id: crate, at: [5, 5], size: [0.5, 0.3], yaw: 0.3, first: 5, last: 10, period: 20}
doors: [{id: door, at: [3, 2.5], yaw: 1.57, times: [2], seconds: 1}]
walkers: [{id: anna, waypoints: [[4.5, 1], [4.5, 4]], speed: 0.8, social_distance: 0.4}]
docks: [{at: [9.5, 0.5]}]
models:
  slow: {base: turtlebot2, drive: {speed: 0.2}}
robots:
  - {id: Robot1, cell: 0, model: turtlebot2, sensor: lidar}
  - {id: Robot2, at: [9, 5], yaw: 1.5, model: slow, override: {radius: 0.15}}
  - {id: Robot3, cell: 5}
"""


def write(folder: Path, text: str) -> Path:
    (folder / "scene.yaml").write_text(text)
    return folder / "scene.yaml"


def test_a_scene_has_all_kinds_of_things(tmp_path: Path) -> None:
    world = load_scene(write(tmp_path, FULL)).build()
    one, two, three = (world.robots[f"Robot{number}"] for number in (1, 2, 3))
    assert (one.radius, one.model.sensor, one.model.drive.speed) == (0.177, "lidar", 0.65)
    assert (two.radius, two.model.sensor, two.model.drive.speed) == (0.15, "camera", 0.2)
    assert (three.radius, three.pose) == (0.22, Pose(5.5, 0.5, 0.0))
    assert two.pose == Pose(9.0, 5.0, 1.5)
    assert (world.boxes, list(world.all_boxes)) == ((30,), ["cell_30"])
    assert list(world.doors) == ["door"]
    assert list(world.walkers) == ["anna"]
    assert len(world.spec.docks) == 1
    world.step(6.0)
    assert "crate" in world.all_boxes
    assert world.collisions.total == 0


def test_shipped_models_are_as_their_data_sheets_say() -> None:
    assert {"disc", "turtlebot2"} <= set(shipped_models())
    robot = load_model("turtlebot2")
    assert (robot.radius, robot.drive.speed) == (0.177, 0.65)
    camera = robot.lidar
    assert (camera.beams, camera.min_range, camera.max_range) == (640, 0.45, 10.0)
    assert np.degrees(camera.field_of_view) == pytest.approx(58.0, abs=0.01)
    assert load_model("turtlebot2", "lidar").lidar.full_circle


def test_the_shipped_scene_is_that_of_the_shipped_configs() -> None:
    scene = load_scene(CONFIGS / "scene.yaml")
    assert (scene.rows, scene.columns, scene.cell_size) == (8, 8, 1.0)
    assert list(scene.build().robots) == ["Robot1", "Robot2", "Robot3"]
    assert scene.floor().grid == FLOOR
    assert sorted(FLOOR.blocked) == FLOOR_PARAMETERS["walls"]
    drawn, shipped = scene.draw(), load_map(CONFIGS / "map.yaml")
    np.testing.assert_array_equal(drawn.data, shipped.data)
    assert (drawn.resolution, drawn.origin) == (shipped.resolution, shipped.origin)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("walls: [{line: [[0, 0]]}]", r"walls\[0\]: the line of a wall has at least two points"),
        ("walls: [1, {line: [[0, 0], [1, 1]], at: [1, 1]}]", r"walls\[1\]: a wall has either 'line'"),
        ("walls: [{lines: [[0, 0], [1, 1]]}]", r"walls\[0\].lines: is not a known key"),
        ("boxes: [{id: a, at: [1]}]", r"boxes\[0\].at"),
        ("boxes: [{id: a, at: [1, .nan]}]", r"boxes\[0\].at\[1\]"),
        ("doors: [{id: a, at: [1, 1], width: -1}]", r"doors\[0\].width"),
        ("walkers: [{id: a, waypoints: []}]", r"walkers\[0\].waypoints"),
        ("robots: [{id: R}]", r"robots\[0\]: a robot has either 'cell' or 'at'"),
        ("robots: [{id: R, cell: 1}]\nboxes: [{id: R, at: [5, 5]}]", "two things have the same id: R"),
        ("map: a.yaml\ngrid_map: b.map", "'map' or 'grid_map', not both"),
        ("robotos: []", "did you mean 'robots'"),
    ],
)
def test_a_bad_scene_names_the_place(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_scene(write(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("map: absent.yaml", "map: .*absent.yaml"),
        ("grid_map: absent.map", "grid_map: .*absent.map"),
        ("model: boat", "model: there is no robot model 'boat'; known: disc, turtlebot2"),
        ("robots: [{id: R, cell: 1, model: b}]\nmodels: {b: {base: b}}", "b is based on itself"),
        ("robots: [{id: R, cell: 1, override: {drive: {sped: 1}}}]", "did you mean 'speed'"),
        ("robots: [{id: R, cell: 1, sensor: radar}]", r"robots\[0\]: the robot has no sensor 'radar'"),
        ("robots: [{id: R, at: [0.1, 4]}]", r"robots\[0\]: \(0.1, 4\) is nearer to a wall"),
        (
            "robots: [{id: R, at: [13, 4]}]",
            r"robots\[0\].at: \(13, 4\) is outside of the floor, from \(-0.1, -0.1\) to \(8.1, 8.1\)",
        ),
        ("robots: [{id: R, at: [1, 1]}, {id: S, at: [1.2, 1]}]", r"robots\[1\]: .* R is in the way"),
        ("robots: [{id: R, at: [4, 4]}]\nboxes: [{id: b, at: [4, 4]}]", r"boxes\[0\]: .* R is in the way"),
    ],
)
def test_a_scene_that_cannot_be_built_says_why(tmp_path: Path, text: str, words: str) -> None:
    scene = load_scene(write(tmp_path, text))
    with pytest.raises(ConfigError, match=words):
        scene.build()


def test_robots_may_stand_beside_the_cells_of_a_floor_without_walls_around(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, "enclosed: false\nrobots: [{id: R, at: [13, 4]}]"))
    assert list(scene.build().robots) == ["R"]


# Maps


def room() -> OccupancyMap:
    """6 x 4 m with walls around, a wall inside and a slanted one; turned and shifted in the world."""
    data = np.zeros((80, 120), np.int8)
    data[[0, 1, -2, -1], :] = data[:, [0, 1, -2, -1]] = 100
    data[20:60, 58:62] = 100
    for step in range(20):
        data[20 + step, 20 + step : 23 + step] = 100
    data[70:75, 100:110] = -1
    return OccupancyMap(data, 0.05, Pose(-1.0, 2.0, 0.3))


def test_walls_of_a_map_are_where_its_pixels_are() -> None:
    grid = room()
    walls = walls_of_map(grid)
    assert 20 < len(walls.lines) < 120, "few lines for thousands of pixels"
    middles = (walls.lines[:, :2] + walls.lines[:, 2:]) / 2
    for points in (walls.lines[:, :2], middles):
        rows, columns = grid.world_to_cell(points).T
        for row, column in zip(rows, columns, strict=True):
            around = grid.occupied[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            assert around.any(), "a wall is at most a pixel away from occupied ones"
    assert not np.isnan(walls.lines).any()


def test_a_ros_map_makes_a_world(tmp_path: Path) -> None:
    grid = OccupancyMap(room().data, 0.05, Pose(-1.0, 2.0, 0.0))
    save_map(grid, tmp_path / "room")
    scene = load_scene(
        write(tmp_path, "map: room.yaml\nrobots: [{id: R, at: [0.5, 4.5], model: turtlebot2, sensor: lidar}]")
    )
    world = scene.build()
    assert (world.grid.rows, world.grid.columns, world.grid.origin) == (4, 6, (-1.0, 2.0))
    ranges = world.scan("R")
    assert ranges[0] == pytest.approx(1.4, abs=0.06), "the wall behind is two pixels thick"
    assert ranges[180] == pytest.approx(1.4, abs=0.06), "the wall inside"
    assert scene.draw().values_at([0.5, 4.5]) == 0


def test_cells_of_a_turned_map_are_turned_too(tmp_path: Path) -> None:
    """They are those that a fleet lays over the map: walls, boxes and robots in them are in the room."""
    save_map(room(), tmp_path / "room")
    text = "map: room.yaml\nenclosed: true\nwalls: [4]\nboxes: [16]\nrobots: [{id: R, cell: 10}]"
    scene = load_scene(write(tmp_path, text))
    world = scene.build()
    grid = world.grid
    assert grid.layout == fleet_grid(room()).layout
    assert [world.is_solid(*grid.point(0.5, column), 0.01) for column in (3.9, 4.1, 4.9)] == [
        False,
        True,
        True,
    ]
    assert [world.is_solid(*grid.point(2.5 + off, 4.5 + off), 0.01) for off in (0.28, 0.32)] == [True, False]
    assert world.is_solid(*grid.point(-0.05, 3.0), 0.01)
    drawn = scene.draw(boxes=True)
    assert drawn.values_at([grid.centre(cell) for cell in (4, 10, 16)]).tolist() == [100, 0, 100]


def test_a_movingai_map_makes_a_world(tmp_path: Path) -> None:
    (tmp_path / "m.map").write_text("type octile\nheight 3\nwidth 4\nmap\n....\n.@@.\n....\n")
    text = "grid_map: m.map\ncell_size: 2.0\nrobots: [{id: R, cell: 0}]"
    world = load_scene(write(tmp_path, text)).build()
    assert (world.grid.rows, world.grid.columns, sorted(world.grid.blocked)) == (3, 4, [5, 6])
    assert world.is_solid(3.0, 3.0, 0.1)
    moved = load_scene(write(tmp_path, f"{text}\norigin: [-4, 1.5]")).build()
    assert (moved.grid.origin, moved.robots["R"].pose) == ((-4.0, 1.5), Pose(-3.0, 2.5, 0.0))
    with pytest.raises(ConfigError, match=r"cells \[12\] are not on the map"):
        load_scene(write(tmp_path, f"{text}\nwalls: [12]")).build()


def test_a_drawn_map_shows_what_a_lidar_sees(tmp_path: Path) -> None:
    """Each beam of an exact lidar ends at an occupied pixel of the drawn map."""
    document: dict[str, Any] = yaml.safe_load(FULL)
    document.update(robots=[], boxes=[], doors=[], walkers=[])
    document["walls"][2]["glass"] = False
    scene = load_scene(write(tmp_path, yaml.safe_dump(document)))
    grid = scene.draw()
    world: World = scene.build()
    world.add_robot("R", 24, 0.4)
    spec = world.robots["R"].model.lidar
    ranges = world.scan("R")
    hit = ranges < spec.max_range
    angles = spec.angles()[hit] + 0.4
    x, y = world.grid.centre(24)
    ends = np.stack((x + ranges[hit] * np.cos(angles), y + ranges[hit] * np.sin(angles)), axis=1)
    near = [
        (grid.values_at(ends + np.array((dx, dy))) == 100)
        for dx in (-0.05, 0.0, 0.05)
        for dy in (-0.05, 0.0, 0.05)
    ]
    assert np.any(near, axis=0).mean() > 0.99
    assert grid.values_at([-0.25, -0.25]) == -1
    assert grid.values_at([x, y]) == 0


def test_drawing_is_exact_on_multiples_of_the_resolution(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, "rows: 2\ncolumns: 2\nwalls: [3]"))
    grid = draw_map(scene.floor().walls, [(0.5, 0.5)])
    points = [(0.0, 0.5), (0.05, 0.5), (1.0, 1.0), (0.95, 1.2), (2.0, 0.5), (1.95, 0.5), (1.5, 1.5)]
    assert grid.values_at(points).tolist() == [100, 0, 100, 0, 100, 0, 100]


def test_a_closed_wall_may_name_its_first_point_again(tmp_path: Path) -> None:
    """A thick one ended with a division by zero."""
    text = "walls: [{line: [[1, 1], [4, 1], [4, 4], [1, 1]], closed: true, thickness: 0.1}]"
    world = load_scene(write(tmp_path, text)).build()
    assert (world.is_solid(2.5, 2.5, 0.06), world.is_solid(2.0, 3.0, 0.06)) == (True, False)


@pytest.mark.parametrize("cell_size", ["0.002", "1.0e-09"])
def test_a_map_of_too_many_cells_is_refused(tmp_path: Path, cell_size: str) -> None:
    save_map(OccupancyMap(np.zeros((100, 100), np.int8)), tmp_path / "map")
    scene = load_scene(write(tmp_path, f"map: map.yaml\ncell_size: {cell_size}\n"))
    with pytest.raises(ConfigError, match=r"cell_size: .* more than 1000000 cells; choose larger"):
        scene.build()


def test_a_map_of_walls_that_are_far_away_is_refused(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, "walls: [{line: [[0, 0], [1.0e+7, 1.0e+7]]}]"))
    with pytest.raises(MapError, match="remove walls that are far away"):
        scene.draw()


def test_doors_and_walkers_that_begin_in_a_robot_are_named(tmp_path: Path) -> None:
    text = """
robots: [{id: Robot1, cell: 0}]
doors: [{id: door, at: [0.5, 0.5]}]
walkers: [{id: anna, waypoints: [[4, 4]]}, {id: bert, waypoints: [[0.5, 0.6]]}]
"""
    with pytest.raises(ConfigError) as error:
        load_scene(write(tmp_path, text)).build()
    assert [fault.place for fault in error.value.faults] == ["doors[0]", "walkers[1]"]
