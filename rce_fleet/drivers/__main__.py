"""The simulation as a program: ``python -m rce_fleet.drivers SCENE.json --report FILE``."""

from __future__ import annotations

import asyncio
import logging
import math
from pathlib import Path
from typing import Annotated

import typer
import uvloop

from rce.aio.tasks import errors_in
from rce.config import ConfigError, start_logging
from rce.own_process import end_signals
from rce.ros.core.server import DEFAULT_PORT
from rce.ros.errors import MasterError
from rce.ros.types import TypeRegistry
from rce_client.exceptions import RefusedError
from rce_fleet.drivers.cell_watch import CellWatch, GraphCellWatch
from rce_fleet.drivers.engine_cell_watch import EngineCellWatch, WorldAccount
from rce_fleet.drivers.program import MAX_PORT, Cores, PortTakenError, RunOptions, Simulation
from rce_fleet.drivers.scene import load_scene
from rce_fleet.exceptions import FleetError
from rce_fleet.maps.ros_map import save_map

BAD_SCENE = 2
FAILED = 1


def simulate(
    scene: Annotated[Path, typer.Argument(help="Map, boxes and robots (JSON or YAML).")],
    report: Annotated[
        Path | None, typer.Option(help="Write the state of the world to this file (JSON).")
    ] = None,
    master: Annotated[
        str, typer.Option(help="URL of the engine's master, to put boxes into cells that the planner blocks.")
    ] = "",
    user: Annotated[str, typer.Option(help="User that the fleet belongs to.")] = "testUser",
    password: Annotated[str, typer.Option(envvar="RCE_PASSWORD", help="The user's password.")] = "testUser",  # noqa: S107 - the development user's
    robot_id: Annotated[str, typer.Option(help="The robotID with which the world connects.")] = "world",
    container: Annotated[str, typer.Option(help="Tag of the planner's container.")] = "cTag_fleet",
    planner_core: Annotated[
        str,
        typer.Option(help="Instead of --master: ROS master of a planner that runs without the engine."),
    ] = "",
    core: Annotated[
        list[str] | None,
        typer.Option(
            help="ROS master that robots join in their namespaces: URI or ROBOT=URI; may be repeated."
        ),
    ] = None,
    namespaces: Annotated[
        bool, typer.Option(help="Join the ROS masters in namespaces, with prefixes of frames.")
    ] = True,
    services: Annotated[
        bool, typer.Option("--services", help="Provide the world's services on a ROS core of their own.")
    ] = False,
) -> None:
    """Simulate a world with robots in real time; each robot has its own ROS graph unless --core names one."""
    start_logging(logging.WARNING)
    types = TypeRegistry()
    watch: CellWatch | None = None
    if planner_core:
        watch = GraphCellWatch(planner_core, types)
    elif master:
        watch = EngineCellWatch(WorldAccount(master, user, password, robot_id), container)
    cores = Cores.read(core or (), namespaces=namespaces)
    options = RunOptions(world_port=0 if services else None)
    try:
        simulation = Simulation(
            *(load_scene(scene), types, typer.echo), report=report, watch=watch, cores=cores, options=options
        )
    except ConfigError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(BAD_SCENE) from None
    failure = ""
    try:
        uvloop.run(_until_signal(simulation))
    except* RefusedError as group:
        failure = f"simulation: the engine refused the connection: {next(errors_in(group))}"
    _end_if(failure)


def sim(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="The world: walls, boxes, robots (YAML).")],
    factor: Annotated[
        float,
        typer.Option("--factor", "--rate", help="Simulated seconds per second; 0: as many as possible."),
    ] = 1.0,
    clock: Annotated[
        bool | None,
        typer.Option(
            "--clock/--no-clock",
            help="Publish simulated time on /clock and set use_sim_time; default: unless the factor is 1.",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all noise, instead of the scene's.")] = None,
    core_port: Annotated[
        int,
        typer.Option(
            min=0,
            max=MAX_PORT,
            help="Port of the first robot's ROS core; the others follow. 0: any free ports.",
        ),
    ] = DEFAULT_PORT,
    world_port: Annotated[
        int,
        typer.Option(
            min=0, max=MAX_PORT, help="Port of the core with the world's services; 0: any free port."
        ),
    ] = DEFAULT_PORT - 1,
    core: Annotated[
        list[str] | None,
        typer.Option(
            help="ROS master that robots join in their namespaces: URI or ROBOT=URI; may be repeated."
        ),
    ] = None,
    namespaces: Annotated[
        bool, typer.Option(help="Join the ROS masters in namespaces, with prefixes of frames.")
    ] = True,
    stand_ins: Annotated[
        bool | None,
        typer.Option(
            "--stand-ins/--no-stand-ins",
            help="Run what stands for amcl and move_base on the robots; default: as the scene says.",
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write the state of the world to this file (JSON).")
    ] = None,
    write_map: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.yaml",
            help="Write the map of the scene's walls for map_server (YAML and PGM) and exit.",
        ),
    ] = None,
    headless: Annotated[bool, typer.Option(help="Accepted for scripts; the program has no window.")] = True,
) -> None:
    """Simulate a world; each robot has its own ROS core."""
    del headless
    start_logging(logging.WARNING)
    if factor < 0 or not math.isfinite(factor):
        raise typer.BadParameter(f"must be 0 or more, not {factor}", param_hint="--factor")
    options = RunOptions(
        factor=factor,
        clock=factor != 1.0 if clock is None else clock,
        core_port=core_port,
        world_port=world_port,
        stand_ins=stand_ins,
    )
    try:
        read = load_scene(scene)
        read = read if seed is None else read.model_copy(update={"seed": seed})
        if write_map is not None:
            save_map(read.draw(), write_map.with_suffix(""))
            typer.echo(f"wrote {write_map.with_suffix('.yaml')} and {write_map.with_suffix('.pgm')}")
            return
        cores = Cores.read(core or (), namespaces=namespaces)
        simulation = Simulation(read, TypeRegistry(), typer.echo, report=report, cores=cores, options=options)
    except ConfigError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(BAD_SCENE) from None
    except (FleetError, OSError) as error:
        typer.echo(f"rce sim: {error}", err=True)
        raise typer.Exit(FAILED) from None
    failure = ""
    try:
        uvloop.run(_until_signal(simulation))
    except* (PortTakenError, MasterError) as group:
        failure = f"rce sim: {next(errors_in(group))}"
    _end_if(failure)


def _end_if(failure: str) -> None:
    """End with a message; not called in ``except*``, which would put the exit into a group."""
    if failure:
        typer.echo(failure, err=True)
        raise typer.Exit(FAILED)


async def _until_signal(simulation: Simulation) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in end_signals():
        loop.add_signal_handler(number, stop.set)
    await simulation.run(stop)


def main() -> None:
    """Run the program."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(simulate)
    app()


if __name__ == "__main__":
    main()
