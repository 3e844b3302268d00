"""The initial state of the simulated world: the file that the simulation program reads."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import Field, ValidationError, model_validator

from rce.config import ConfigError, Fault
from rce.config.documents import parse, read_file
from rce.config.validation import Strict, faults_of
from rce_fleet.drivers.robot_models import DEFAULT_MODEL, ModelShelf
from rce_fleet.drivers.scene_items import (
    TAGS,
    Box,
    BoxItem,
    DockItem,
    DoorItem,
    Length,
    LightStart,
    Place,
    RobotStart,
    WalkerItem,
    Wall,
    WallItem,
)
from rce_fleet.exceptions import FleetError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.ros_map import load_map
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map
from rce_fleet.simulation.box import BoxSpec, cell_of_box
from rce_fleet.simulation.light.robots import TIME_STEP
from rce_fleet.simulation.map_walls import draw_map, walls_of_map
from rce_fleet.simulation.walls import Walls, grid_walls
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import Dock, WorldSpec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.planning.scenario import Scenario

MAX_CELLS = 1_000_000
CHARGER_REACH = 0.25
"""Robots that stand so near to the middle of a cell with a charger are charged, metres."""

__all__ = ["Floor", "RobotStart", "Scene", "load_scene", "scene_of"]


class Floor(NamedTuple):
    """What of a scene never moves: its cells and its walls."""

    grid: GridMap
    walls: Walls


class Scene(Strict):
    """A floor with walls, boxes, doors, walkers and robots."""

    rows: int = Field(default=8, ge=1)
    columns: int = Field(default=8, ge=1)
    cell_size: Length = 1.0
    """Edge of a cell, metres."""
    origin: Place = (0.0, 0.0)
    """Outer corner of cell 0, metres."""
    enclosed: bool | None = None
    """Whether there is a wall around the cells; if not given: unless ``map`` is."""
    map: str = ""
    """A map in ROS's format (YAML), whose occupied pixels are walls; relative to the scene."""
    grid_map: str = ""
    """A map in MovingAI's format, whose blocked cells are walls; relative to the scene."""
    walls: tuple[Wall, ...] = Field(default=(), strict=False)
    """Cells that are always solid, and walls."""
    boxes: tuple[Box, ...] = Field(default=(), strict=False)
    """Cells with a box, whether the planner knows of it or not, and boxes at other places."""
    doors: tuple[DoorItem, ...] = Field(default=(), strict=False)
    walkers: tuple[WalkerItem, ...] = Field(default=(), strict=False)
    docks: tuple[DockItem, ...] = Field(default=(), strict=False)
    models: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Robot models by name: what each changes of its ``base``."""
    model: str = DEFAULT_MODEL
    """Model of the robots that name none."""
    robots: tuple[RobotStart, ...] = Field(default=(), strict=False)
    light_robots: tuple[LightStart, ...] = Field(default=(), strict=False)
    """Robots that advance together, without a physics engine; they localize and drive by themselves."""
    light_per_graph: int = Field(default=50, ge=1)
    """How many light robots share a ROS graph, at most."""
    stand_ins: bool = True
    """Whether robots run what stands for ``amcl`` and ``move_base``."""
    seed: int = Field(default=0, ge=0)
    """Seed of all noise."""

    @model_validator(mode="after")
    def _check_cells(self) -> Scene:
        if self.map and self.grid_map:
            raise ValueError("a scene has 'map' or 'grid_map', not both")
        _check_size(self.rows, self.columns)
        reserved = sorted(box.id for box in self.loose_boxes if cell_of_box(box.id) is not None)
        if reserved:
            raise ValueError(f"{', '.join(reserved)}: boxes in cells have such ids; choose other ids")
        starts = [robot.cell for robot in self.robots if robot.cell is not None]
        starts += [robot.cell for robot in self.light_robots]
        if not self._cells_from_map:
            _check_inside((*self.wall_cells, *self.box_cells, *starts), self.rows * self.columns)
        ids = [robot.id for robot in self.robots] + [door.id for door in self.doors]
        ids += [robot.id for robot in self.light_robots]
        ids += [walker.id for walker in self.walkers] + [box.id for box in self.loose_boxes]
        if len({robot.id for robot in self.robots}) < len(self.robots) or len(set(starts)) < len(starts):
            raise ValueError("two robots have the same id or the same cell")
        if len(set(ids)) < len(ids):
            twice = sorted(name for name, count in Counter(ids).items() if count > 1)
            raise ValueError(f"two things have the same id: {', '.join(twice)}")
        taken = sorted({*self.wall_cells, *self.box_cells}.intersection(starts))
        if taken:
            raise ValueError(f"robots start in the blocked cells {taken}; choose other cells")
        return self

    @property
    def wall_cells(self) -> tuple[int, ...]:
        """Cells that are always solid."""
        return tuple(wall for wall in self.walls if isinstance(wall, int))

    @property
    def box_cells(self) -> tuple[int, ...]:
        """Cells with a box."""
        return tuple(box for box in self.boxes if isinstance(box, int))

    @property
    def loose_boxes(self) -> tuple[BoxItem, ...]:
        """Boxes that do not belong to a cell."""
        return tuple(box for box in self.boxes if isinstance(box, BoxItem))

    @property
    def grid(self) -> GridMap:
        """The cells, with the solid ones."""
        return self.floor().grid

    @property
    def _cells_from_map(self) -> bool:
        """Whether the size of the floor is that of a map."""
        return bool(self.grid_map or (self.map and not {"rows", "columns"} & self.model_fields_set))

    def floor(self) -> Floor:
        """Return cells and walls; maps are read.

        Raises:
            ConfigError: A map cannot be read, or a cell is not on it.
        """
        try:
            drawn = load_map(Path(self.map)) if self.map else None
        except (FleetError, OSError) as error:
            raise ConfigError("scene", [Fault("map", str(error))]) from error
        grid = self._grid(drawn)
        try:
            _check_inside((*self.wall_cells, *self.box_cells), len(grid))
        except ValueError as error:
            raise ConfigError("scene", [Fault("walls, boxes", str(error))]) from error
        grid = grid.with_blocked({*grid.blocked, *self.wall_cells})
        enclosed = not self.map if self.enclosed is None else self.enclosed
        walls = grid_walls(grid, enclosed=enclosed)
        if drawn is not None:
            walls += walls_of_map(drawn)
        for item in self.walls:
            if isinstance(item, WallItem):
                walls += item.walls()
        return Floor(grid, walls)

    def _grid(self, drawn: OccupancyMap | None) -> GridMap:
        if self.grid_map:
            try:
                return replace(read_map(Path(self.grid_map), cell_size=self.cell_size), origin=self.origin)
            except (FleetError, OSError) as error:
                raise ConfigError("scene", [Fault("grid_map", str(error))]) from error
        if drawn is None or not self._cells_from_map:
            return GridMap(self.rows, self.columns, self.cell_size, self.origin)
        width, height = drawn.size
        rows, columns = (max(1, ceil(length / self.cell_size - 1e-9)) for length in (height, width))
        try:
            _check_size(rows, columns)
        except ValueError as error:
            raise ConfigError("scene", [Fault("cell_size", f"{error}; choose larger cells")]) from error
        corner = drawn.origin
        return GridMap(rows, columns, self.cell_size, (corner.x, corner.y), yaw=corner.yaw)

    def draw(self, resolution: float = 0.05, *, boxes: bool = False) -> OccupancyMap:
        """Return the map that a perfect mapper would make of the walls; doors are not on it.

        Args:
            resolution: Edge of a cell, metres.
            boxes: Whether the boxes that are there at the start are on it.
        """
        floor = self.floor()
        grid, walls = floor.grid, floor.walls
        if boxes:
            size = WorldSpec().box_size
            specs = [BoxSpec(Pose(*grid.centre(cell), grid.yaw), size, size) for cell in self.box_cells]
            specs += [box.spec() for box in self.loose_boxes]
            walls += Walls(tuple(spec.block for spec in specs if spec.is_due(0.0)))
        inside = [grid.centre(cell) for cell in grid.free if not (boxes and cell in self.box_cells)]
        return draw_map(walls, inside, resolution=resolution)

    def build(self, source: str = "scene") -> World:
        """Create the world.

        Args:
            source: Name of the scene's file, for errors.

        Raises:
            ConfigError: Something has no room where it is to stand, or a robot's model is wrong.
        """
        floor = self.floor()
        default = ModelShelf(self.models, source).model(self.model, {}, place="model")
        docks = tuple(Dock(*dock.at, dock.reach) for dock in self.docks)
        spec = WorldSpec(model=default, docks=docks)
        if self.light_robots and not self.robots:
            spec = replace(spec, time_step=TIME_STEP)  # nothing else needs shorter ones
        world = World(floor.grid, spec, seed=self.seed, walls=floor.walls)
        faults: list[Fault] = []
        for index, robot in enumerate(self.robots):
            try:
                self.place(robot, world, place=f"robots[{index}]", source=source)
            except ConfigError as error:
                faults += error.faults
        self._furnish(world, faults)
        self._place_light_robots(world, faults)
        if faults:
            raise ConfigError(source, faults)
        return world

    def place(self, robot: RobotStart, world: World, *, place: str = "robot", source: str = "scene") -> None:
        """Put a robot into a world.

        Raises:
            ConfigError: It has no room, or its model is wrong.
        """
        grid, shelf = world.grid, ModelShelf(self.models, source)
        changes = {**robot.override, **({"sensor": robot.sensor} if robot.sensor else {})}
        model = shelf.model(robot.model or self.model, changes, place=place)
        if robot.cell is not None and robot.cell not in grid:
            fault = Fault(f"{place}.cell", f"{robot.cell} is not on the map of {len(grid)} cells")
            raise ConfigError(source, [fault])
        x, y = robot.at if robot.at is not None else grid.centre(robot.cell or 0)
        if grid.cell_at(x, y) is None and not self._has_floor_at(x, y, world):
            left, low, right, high = world.walls.bounds
            floor = f"the floor, from ({left:g}, {low:g}) to ({right:g}, {high:g})"
            raise ConfigError(source, [Fault(f"{place}.at", f"({x:g}, {y:g}) is outside of {floor}")])
        if world.is_solid(x, y, model.radius):
            fault = Fault(
                place, f"({x:g}, {y:g}) is nearer to a wall or box than the hull's {model.radius:g} m"
            )
            raise ConfigError(source, [fault])
        try:
            world.place_robot(robot.id, Pose(x, y, robot.yaw), model)
        except (FleetError, ValueError) as error:
            raise ConfigError(source, [Fault(place, str(error))]) from error

    def _has_floor_at(self, x: float, y: float, world: World) -> bool:
        """Return whether a point beside the cells has a floor: inside of walls, or if nothing is around."""
        if not self.map and self.enclosed is False:
            return True
        left, low, right, high = world.walls.bounds
        return left <= x <= right and low <= y <= high

    def _place_light_robots(self, world: World, faults: list[Fault]) -> None:
        """Put light robots into a world; note if one has no room."""
        outside = [start.cell for start in self.light_robots if start.cell not in world.grid]
        if outside:
            text = f"cells {outside} are not on the map of {len(world.grid)} cells"
            faults.append(Fault("light_robots", text))
        elif self.light_robots:
            centre = world.grid.centre
            starts = {start.id: Pose(*centre(start.cell), start.yaw) for start in self.light_robots}
            try:
                world.add_light_robots(starts)
            except (FleetError, ValueError) as error:
                faults.append(Fault("light_robots", str(error)))

    def _furnish(self, world: World, faults: list[Fault]) -> None:
        """Add boxes, doors and walkers; note what has no room."""
        for index, box in enumerate(self.boxes):
            try:
                if isinstance(box, int):
                    world.add_box(box)
                else:
                    world.put_box(box.id, box.spec())
            except FleetError as error:
                faults.append(Fault(f"boxes[{index}]", str(error)))
        for index, door in enumerate(self.doors):
            try:
                world.add_door(door.id, door.spec())
            except FleetError as error:
                faults.append(Fault(f"doors[{index}]", str(error)))
        for index, walker in enumerate(self.walkers):
            try:
                world.add_walker(walker.id, walker.spec())
            except FleetError as error:
                faults.append(Fault(f"walkers[{index}]", str(error)))


def _check_size(rows: int, columns: int) -> None:
    if rows * columns > MAX_CELLS:
        raise ValueError(f"{rows} x {columns} is more than {MAX_CELLS} cells")


def _check_inside(cells: Iterable[int], count: int) -> None:
    outside = sorted(cell for cell in cells if not 0 <= cell < count)
    if outside:
        raise ValueError(f"cells {outside} are not on the map of {count} cells")


def scene_of(
    scenario: Scenario,
    seed: int = 0,
    *,
    full: int | None = None,
    light_per_graph: int = 50,
    chargers: Iterable[int] = (),
) -> Scene:
    """Return the initial state of a scenario, with known and hidden boxes.

    Its robots are TurtleBots with a lidar; localization and navigation are for other programs.

    Args:
        scenario: The scenario.
        seed: Seed of all noise.
        full: So many robots, the first ones, are in the physics engine, the others are light ones; None: all.
        light_per_graph: How many light robots share a ROS graph, at most.
        chargers: Cells in which robots are charged.
    """
    grid = scenario.grid
    starts = list(zip(scenario.robots, scenario.starts, scenario.headings, strict=True))
    full = len(starts) if full is None else full
    return Scene(
        rows=grid.rows,
        columns=grid.columns,
        cell_size=grid.cell_size,
        walls=tuple(sorted(grid.blocked)),
        boxes=tuple(sorted(scenario.boxes)),
        model="turtlebot2",
        robots=tuple(
            RobotStart(id=robot, cell=cell, yaw=yaw, sensor="lidar") for robot, cell, yaw in starts[:full]
        ),
        light_robots=tuple(LightStart(id=robot, cell=cell, yaw=yaw) for robot, cell, yaw in starts[full:]),
        light_per_graph=light_per_graph,
        docks=tuple(DockItem(at=grid.centre(cell), reach=CHARGER_REACH) for cell in chargers),
        stand_ins=False,
        seed=seed,
    )


def load_scene(path: Path) -> Scene:
    """Read a scene, JSON or YAML.

    Raises:
        ConfigError: The file cannot be read, or is not valid.
    """
    try:
        scene = Scene.model_validate(parse(read_file(path), str(path)))
    except ValidationError as error:
        faults = [fault._replace(place=_without_tags(fault.place)) for fault in faults_of(error, Scene)]
        raise ConfigError(str(path), faults) from error
    maps = {key: str(path.parent / value) for key in ("map", "grid_map") if (value := getattr(scene, key))}
    return scene.model_copy(update=maps)


def _without_tags(place: str) -> str:
    for tag in TAGS:
        place = place.replace(f".{tag}", "")
    return place
