"""Measure the simulated world: ``python -m benchmarks.simulation [--quick]``.

``world``: what a simulated second of driving robots costs, and a ray of their sensors, by the number of
robots. ``nodes``: the same with each robot's ROS node, which publishes to no subscriber.

Times are those of the processor that this thread used, so that other load does not count; the least of some
runs counts.
"""

from __future__ import annotations

import argparse
import asyncio
from contextlib import AsyncExitStack
from time import thread_time
from typing import Any

import uvloop

from benchmarks.figures import Results, show
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.drivers.robot_models import load_model
from rce_fleet.drivers.runner import WorldRunner
from rce_fleet.geometry.poses import Twist
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import WorldSpec

Rows = list[dict[str, Any]]

SIZES = (1, 10, 100)
SIDE = 24
"""Cells of a side of the floor, one in ten of them solid."""
TARGET = 1.0
"""100 robots with lidars should run at least in real time on one core."""


def make_world(robots: int, sensor: str) -> World:
    """Return a floor with TurtleBots that drive in small circles, and boxes."""
    solid = frozenset(cell for cell in range(SIDE * SIDE) if cell * 7919 % 10 == 0)
    grid = GridMap(SIDE, SIDE, blocked=solid)
    world = World(grid, WorldSpec(model=load_model("turtlebot2", sensor)))
    places = grid.free[:: max(1, len(grid.free) // (robots + 20))]
    for number, cell in enumerate(places[:robots]):
        world.add_robot(f"Robot{number}", cell)
    for cell in places[robots : robots + 20]:
        world.add_box(cell)
    return world


def command(world: World) -> None:
    """Keep the robots' watchdogs quiet."""
    for robot in world.robots.values():
        robot.drive(Twist(0.1, 1.0))


def cost_of_a_second(world: World) -> tuple[float, float]:
    """Return the seconds that the physics and the sensors of a simulated second take."""
    physics = sensors = 0.0
    for _ in range(10):
        command(world)
        began = thread_time()
        world.step(0.1)
        between = thread_time()
        world.scans(world.robots)
        physics, sensors = physics + between - began, sensors + thread_time() - between
    return physics, sensors


def measure_world(passes: int) -> Rows:
    """Measure worlds without ROS."""
    rows: Rows = []
    for sensor in ("lidar", "camera"):
        for robots in SIZES:
            world = make_world(robots, sensor)
            physics, sensors = min((cost_of_a_second(world) for _ in range(passes)), key=sum)
            rays = robots * world.spec.model.lidar.beams * 10
            rows.append(
                {
                    "robots": robots,
                    "sensor": sensor,
                    "physics ms/s": round(1000 * physics, 1),
                    "sensors ms/s": round(1000 * sensors, 1),
                    "rays/s": round(rays / sensors, -3),
                    "us per ray": round(1e6 * sensors / rays, 2),
                    "x real time": round(1 / (physics + sensors), 1),
                    "target": TARGET if robots == SIZES[-1] else "",
                }
            )
    return rows


async def measure_nodes(passes: int) -> Rows:
    """Measure worlds whose robots are ROS nodes, with a subscriber to each scan and odometry."""
    rows: Rows = []
    for robots in SIZES:
        world = make_world(robots, "lidar")
        runner = WorldRunner(world)
        async with AsyncExitStack() as stack:
            core = await stack.enter_async_context(Core(port=0))
            types = TypeRegistry()
            for robot in world.robots:
                node = Node(
                    "robot", namespace=robot, argv=(), master_uri=core.uri, types=types, signals=False
                )
                driver = RobotDriver(await stack.enter_async_context(node), world, robot, stand_in=False)
                await driver.start()
                await node.subscribe("scan", "sensor_msgs/LaserScan", lambda _: None)
                await node.subscribe("odom", "nav_msgs/Odometry", lambda _: None)
                runner.drivers[robot] = driver
            seconds = []
            for _ in range(passes):
                command(world)
                began = thread_time()
                for number in range(50):
                    if number % 25 == 0:
                        command(world)
                    runner.tick()
                    await asyncio.sleep(0)
                seconds.append(thread_time() - began)
        rows.append(
            {
                "robots": robots,
                "sensor": "lidar",
                "ms/s": round(1000 * min(seconds), 1),
                "x real time": round(1 / min(seconds), 1),
                "target": TARGET if robots == SIZES[-1] else "",
            }
        )
    return rows


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulation", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer passes")
    options = parser.parse_args()
    passes = 2 if options.quick else 5
    results = Results("simulation", quick=options.quick)
    world = measure_world(passes)
    results.keep("world", world)
    show("Simulated world, a core's seconds for a simulated second", world)
    results.begin("nodes")
    nodes = uvloop.run(measure_nodes(passes))
    results.keep("nodes", nodes)
    show("The same with ROS nodes", nodes)
    print("results:", results.save())


if __name__ == "__main__":
    main()
