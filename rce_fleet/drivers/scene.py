"""The initial state of the simulated world: the file that the simulation program reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field, ValidationError, model_validator

from rce.config.documents import parse, read_file
from rce.config.exceptions import ConfigError, Fault
from rce.config.validation import Strict, faults_of
from rce_fleet.exceptions import OccupiedError
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.world import World

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.planning.scenario import Scenario

MAX_CELLS = 1_000_000


class RobotStart(Strict):
    """A robot and its start."""

    id: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    cell: int = Field(ge=0)
    yaw: float = Field(default=0.0, allow_inf_nan=False)
    """Heading, radians counter-clockwise from x."""


class Scene(Strict):
    """A floor with walls, boxes and robots."""

    rows: int = Field(default=8, ge=1)
    columns: int = Field(default=8, ge=1)
    cell_size: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    """Edge of a cell, metres."""
    walls: tuple[int, ...] = Field(default=(), strict=False)
    """Cells that are always solid."""
    boxes: tuple[int, ...] = Field(default=(), strict=False)
    """Cells with a box, whether the planner knows of it or not."""
    robots: tuple[RobotStart, ...] = Field(default=(), strict=False)
    seed: int = Field(default=0, ge=0)
    """Seed of the sensor noise."""

    @model_validator(mode="after")
    def _check_cells(self) -> Scene:
        count = self.rows * self.columns
        if count > MAX_CELLS:
            raise ValueError(f"{self.rows} x {self.columns} is more than {MAX_CELLS} cells")
        starts = [robot.cell for robot in self.robots]
        outside = sorted(cell for cell in (*self.walls, *self.boxes, *starts) if not 0 <= cell < count)
        if outside:
            raise ValueError(f"cells {outside} are not on the map of {count} cells")
        if len({robot.id for robot in self.robots}) < len(starts) or len(set(starts)) < len(starts):
            raise ValueError("two robots have the same id or the same cell")
        taken = sorted({*self.walls, *self.boxes}.intersection(starts))
        if taken:
            raise ValueError(f"robots start in the blocked cells {taken}; choose other cells")
        return self

    @property
    def grid(self) -> GridMap:
        """The map with its walls."""
        return GridMap(self.rows, self.columns, self.cell_size, blocked=frozenset(self.walls))

    def build(self) -> World:
        """Create the world."""
        world = World(self.grid, seed=self.seed)
        try:
            for robot in self.robots:
                world.add_robot(robot.id, robot.cell, robot.yaw)
            for cell in self.boxes:
                world.add_box(cell)
        except OccupiedError as error:
            raise ConfigError("scene", [Fault("robots", str(error))]) from error
        return world


def scene_of(scenario: Scenario, seed: int = 0) -> Scene:
    """Return the initial state of a scenario, with known and hidden boxes."""
    grid = scenario.grid
    starts = zip(scenario.robots, scenario.starts, scenario.headings, strict=True)
    return Scene(
        rows=grid.rows,
        columns=grid.columns,
        cell_size=grid.cell_size,
        walls=tuple(sorted(grid.blocked)),
        boxes=tuple(sorted(scenario.boxes)),
        robots=tuple(RobotStart(id=robot, cell=cell, yaw=yaw) for robot, cell, yaw in starts),
        seed=seed,
    )


def load_scene(path: Path) -> Scene:
    """Read a scene, JSON or YAML.

    Raises:
        ConfigError: The file cannot be read, or is not valid.
    """
    try:
        return Scene.model_validate(parse(read_file(path), str(path)))
    except ValidationError as error:
        raise ConfigError(str(path), faults_of(error, Scene)) from error
