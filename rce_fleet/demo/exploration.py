"""``rce demo --slam``: one robot explores, and the fleet's map and grid are made from what it saw."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from rce.config import configs_dir
from rce.ros.node import Message, Node
from rce.ros.tf import TransformError, TransformListener
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.programs import Program, ProgramGroup, rce_command
from rce_fleet.demo.robots import RobotGraph, environment
from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.agreement import MapAgreement, compare_maps
from rce_fleet.maps.fleet_grid import fleet_grid
from rce_fleet.maps.occupancy_map import FREE, OccupancyMap
from rce_fleet.maps.ros_map import load_map, save_map
from rce_fleet.nodes.explore import COMPLETE, IN_PROGRESS, RETURNED
from rce_fleet.nodes.planar import pose_of, read_map

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.demo.config import DemoConfig
    from rce_fleet.station.client import StationClient

LAUNCH_FILE = "turtlebot/explore.launch"
NODE = "rce_demo_exploration"
TIMEOUT = 600.0
"""Seconds that an exploration may take."""
BLOCKED_SHARE = 0.3
"""A cell is blocked if more of it is occupied or unknown: walls on the borders of cells block none."""
DOCK_RADIUS = 0.35
"""Around the docks of robots that stood there, the map is drawn free, metres."""
RETRY_S = 0.5
RETRIES = 60


@dataclass(frozen=True, slots=True)
class Explored:
    """The outcome of an exploration.

    Attributes:
        seconds: From the first goal to the last.
        agreement: The map beside the true walls.
        pose: Where the robot stands now, on the map.
        blocked: Cells of the fleet's grid that the map blocks.
    """

    seconds: float
    agreement: MapAgreement
    pose: Pose
    blocked: tuple[int, ...]

    def as_json(self) -> dict[str, Any]:
        """Return what the report says of it."""
        return {
            "seconds": round(self.seconds, 1),
            **self.agreement.as_json(),
            "blocked_cells": list(self.blocked),
        }

    @property
    def initial_pose(self) -> dict[str, float]:
        """The robot's pose as arguments of its launch file."""
        x, y, yaw = self.pose.as_array().tolist()
        return {"initial_pose_x": x, "initial_pose_y": y, "initial_pose_a": yaw}


async def explore(
    group: ProgramGroup,
    config: DemoConfig,
    graph: RobotGraph,
    arguments: Mapping[str, object],
    say: Callable[[str], None],
) -> Explored:
    """Let a robot explore the floor, and save the map in ROS's format as ``config.map_file``.

    Args:
        group: Gets the robot's programs; they have ended afterwards.
        config: What the demo runs.
        graph: Where the robot's nodes are.
        arguments: Of its launch file: names and frames.
        say: Prints a line for the user.

    Raises:
        DemoError: The exploration did not end in time.
    """
    listening = _Listening(graph)
    async with listening:
        program = await _start(group, config, graph, arguments)
        say(f"{graph.robot} explores the floor")
        try:
            async with asyncio.timeout(TIMEOUT):
                await listening.done.wait()
        except TimeoutError:
            raise DemoError(f"{graph.robot} did not explore the floor within {TIMEOUT:g} s") from None
        pose, drawn = listening.pose(), listening.drawn
    await group.end(program)
    if drawn is None or pose is None:
        raise DemoError(f"{graph.robot} explored the floor, but there is no map, or it has no place on it")
    others = _docks(config, but=graph.robot)
    made = await asyncio.to_thread(without_robots, drawn, others)
    await asyncio.to_thread(save_map, made, config.map_file.with_suffix(""))
    agreement = compare_maps(made, load_map(config.true_map_file))
    blocked = tuple(sorted(grid_of(made, config)))
    explored = Explored(listening.seconds, agreement, pose, blocked)
    say(
        f"the floor is explored in {explored.seconds:.0f} s: {100 * agreement.explored:.1f} % of it is known,"
        f" walls are drawn {1e3 * agreement.wall_error_m:.0f} mm off on average"
    )
    return explored


def grid_of(made: OccupancyMap, config: DemoConfig) -> frozenset[int]:
    """Return the blocked cells of the fleet's grid over a map.

    Robots stand at their docks: these cells are free, whatever the map shows of them.
    """
    grid = config.scenario.grid
    blocked = fleet_grid(
        made,
        grid.cell_size,
        origin=Pose(*grid.origin, grid.yaw),
        rows=grid.rows,
        columns=grid.columns,
        blocked_share=BLOCKED_SHARE,
    ).blocked
    return blocked.difference(config.scenario.starts)


def without_robots(drawn: OccupancyMap, docks: Iterable[tuple[float, float]]) -> OccupancyMap:
    """Return a map on which the robots that stood at their docks are not drawn.

    Args:
        drawn: The map.
        docks: Their places, metres.
    """
    data = drawn.data.copy()
    places = drawn.cell_to_world(np.argwhere(np.ones(data.shape, np.bool_))).reshape(*data.shape, 2)
    for x, y in docks:
        near = np.hypot(places[..., 0] - x, places[..., 1] - y) <= DOCK_RADIUS
        data[near] = FREE
    return replace(drawn, data=data)


async def block_cells(station: StationClient, cells: Iterable[int], say: Callable[[str], None]) -> None:
    """Block cells of the fleet's grid, as the map says.

    Raises:
        DemoError: The station or its planner does not answer.
    """
    for cell in cells:
        for attempt in range(RETRIES):
            try:
                await station.set_blocked(cell, blocked=True)
                break
            except RequestRefusedError as error:
                say(f"refused: {error}")
                break
            except StationUnavailableError as error:
                if attempt == RETRIES - 1:
                    raise DemoError(f"cell {cell} cannot be blocked: {error}") from error
                await asyncio.sleep(RETRY_S)


async def _start(
    group: ProgramGroup, config: DemoConfig, graph: RobotGraph, arguments: Mapping[str, object]
) -> Program:
    """Start the nodes of a robot that explores."""
    scenario = config.scenario
    index = scenario.robots.index(graph.robot)
    x, y = scenario.grid.centre(scenario.starts[index])
    known = {key: value for key, value in arguments.items() if key in ("tf_prefix", "robot", "relay")}
    given = {**known, "map_start_pose": [x, y, scenario.headings[index]]}
    words = (f"{name}:={value}" for name, value in given.items())
    # A process for each node: the mapper has much to compute, and must not delay the safety stage.
    options = ("--wait", "--no-log", "--screen")
    argv = [*rce_command("launch"), *options, str(configs_dir() / LAUNCH_FILE), *words]
    name = f"explore-{graph.robot}"
    return await group.start(name, [*graph.host, *argv], env=environment(config, graph.uri))


def _docks(config: DemoConfig, but: str) -> list[tuple[float, float]]:
    """Return where the other robots stand."""
    scenario = config.scenario
    starts = zip(scenario.robots, scenario.starts, strict=True)
    return [scenario.grid.centre(start) for robot, start in starts if robot != but]


class _Listening:
    """Hears the map and the explorer's status in a robot's graph. An async context manager.

    Attributes:
        done: Set at the end of the exploration.
        drawn: The newest map.
    """

    def __init__(self, graph: RobotGraph) -> None:
        self.done = asyncio.Event()
        self.drawn: OccupancyMap | None = None
        self._graph = graph
        self._began: float | None = None
        self._ended: float | None = None
        self._stack = AsyncExitStack()
        self._transforms: TransformListener

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            node = Node(NODE, argv=(), master_uri=self._graph.uri, signals=False, rosout=False)
            await stack.enter_async_context(node)
            self._transforms = await stack.enter_async_context(TransformListener(node, prefix=""))
            await node.subscribe("/map", "nav_msgs/OccupancyGrid", self._take_map)
            await node.subscribe(self._graph.topic("explore/status"), "std_msgs/String", self._take_status)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_error: object) -> None:
        await self._stack.aclose()

    @property
    def seconds(self) -> float:
        """How long the exploration took."""
        return (self._ended or time.monotonic()) - (self._began or time.monotonic())

    def pose(self) -> Pose | None:
        """Return where the robot is on the map; None if it is not known."""
        try:
            return pose_of(self._transforms.lookup("map", self._graph.frame("base_link")).transform)
        except TransformError:
            return None

    def _take_map(self, message: Message) -> None:
        self.drawn = read_map(message)

    def _take_status(self, message: Message) -> None:
        if message.data == IN_PROGRESS and self._began is None:
            self._began = time.monotonic()
        if message.data in (COMPLETE, RETURNED):
            self._ended = time.monotonic()
            self.done.set()
