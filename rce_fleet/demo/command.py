"""The command ``rce demo``."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
from collections.abc import Callable, Coroutine, Iterable
from contextlib import AsyncExitStack
from dataclasses import fields, replace
from pathlib import Path
from random import Random
from typing import Annotated, Any, NamedTuple, TypeVar, assert_never

import aiohttp
import typer
import uvloop

from rce.cli.program_files import from_file
from rce.cli.replicas import COUNTS
from rce.config import Runtime
from rce.own_process import end_signals
from rce_fleet.demo.config import CoreProgram, DemoConfig, MachineBackend, Mode, TaskSource
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.modes import start_demo
from rce_fleet.demo.random_goals import RandomGoals, send_random_goals
from rce_fleet.demo.resources import ANY, MAX_PORT, Ports, run_folder
from rce_fleet.demo.scenario import MANY, choose_scenario, find_lanes, lane_scenario
from rce_fleet.demo.speed import tell_speed
from rce_fleet.demo.worlds import NamedWorld, find_world, on_lanes
from rce_fleet.exceptions import FleetError
from rce_fleet.planning.lanes import LaneGraph
from rce_fleet.planning.scenario import Scenario
from rce_fleet.station.client import StationClient

DEFAULT_ROBOTS, DEFAULT_ROBOTS_OF_SCEN = 3, 4
MAX_ROBOTS = 1000
TIMEOUT = 180.0
TIMEOUT_PER_ROBOT = 1.0
"""Seconds that a run with many robots may take longer, for each of them."""

T = TypeVar("T")


@from_file("demo")
def demo(
    mode: Annotated[
        Mode, typer.Option(help="What carries messages: the engine, one ROS core, or one core per robot.")
    ] = Mode.CLOUD,
    headless: Annotated[
        bool, typer.Option("--headless", help="Drive to goals once without a page, report, exit.")
    ] = False,
    offload: Annotated[
        bool, typer.Option("--offload", help="Run localization and navigation in the robots' containers.")
    ] = False,
    robots: Annotated[
        int | None, typer.Option(min=1, max=MAX_ROBOTS, help="Number of robots [3; 4 with --scen].")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts, goals, boxes and sensor noise.")] = 0,
    timeout: Annotated[
        float | None,
        typer.Option(min=1, help="Maximum duration of a headless run, seconds [180, more for many robots]."),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(min=1, help="Stream tasks for so many seconds in a headless run, and kill the planner."),
    ] = None,
    tasks: Annotated[
        TaskSource,
        typer.Option(help="With --duration: tasks for the fleet manager, or goals for each robot."),
    ] = TaskSource.MANAGER,
    report: Annotated[
        Path | None, typer.Option(help="Write the report of a headless run to this file (JSON).")
    ] = None,
    blocked_cells: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Cells that a headless run blocks [1; 0 with light robots or lanes];"
            " fewer if goals are cut off.",
        ),
    ] = None,
    world: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="Floor or warehouse, or a map of MovingAI (default: floor)."),
    ] = "",
    full_stack: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Number of robots with AMCL and move_base; others are light (all; 0 above 20 robots).",
        ),
    ] = None,
    robots_per_container: Annotated[
        int, typer.Option(min=1, max=MAX_ROBOTS, help="Light robots that share a container and processes.")
    ] = 50,
    scen: Annotated[
        Path | None,
        typer.Option(help="Starts and goals on the map (MovingAI .scen).", exists=True, dir_okay=False),
    ] = None,
    lanes: Annotated[
        Path | None,
        typer.Option(help="Let robots drive on the lanes of this file only (YAML or JSON).", dir_okay=False),
    ] = None,
    replicas: Annotated[
        int,
        typer.Option(
            metavar="N", help="Run 3 or 5 masters on an etcd; the key k and the page kill the leading one."
        ),
    ] = 1,
    slam: Annotated[
        bool, typer.Option("--slam", help="Begin without a map: the first robot explores and makes it.")
    ] = False,
    auto: Annotated[
        bool, typer.Option("--auto/--no-auto", help="Send robots to random goals until you set a goal.")
    ] = True,
    port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of the page [9080; headless: any].")
    ] = None,
    http_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of the engine's clients and REST [9000].")
    ] = None,
    control_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of the engine's task sets [8080].")
    ] = None,
    ws_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of the robots' WebSockets [9010].")
    ] = None,
    robot_link_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of links to robot endpoints [10030].")
    ] = None,
    container_link_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of links to containers [10031].")
    ] = None,
    runtime: Annotated[
        Runtime | None, typer.Option(help="Runtime of the containers (default: auto).")
    ] = None,
    core_port: Annotated[
        int | None, typer.Option(min=0, max=MAX_PORT, help="Port of the ROS core of --mode single [11311].")
    ] = None,
    core: Annotated[
        CoreProgram, typer.Option(help="Program that is the ROS core of --mode single.")
    ] = CoreProgram.RCE,
    core_uri: Annotated[str, typer.Option(help="Use this running ROS master in --mode single.")] = "",
    machines: Annotated[
        MachineBackend, typer.Option(help="How --mode multi represents machines.")
    ] = MachineBackend.AUTO,
    state_dir: Annotated[
        Path | None, typer.Option(help="Keep configs, logs and state in a new subfolder of this folder.")
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show the output of all programs.")
    ] = False,
) -> None:
    """Run a simulated fleet with its planner and the operator's page."""
    given = {
        "page": port,
        "http": http_port,
        "control": control_port,
        "ws": ws_port,
        "robot_link": robot_link_port,
        "container_link": container_link_port,
        "core": core_port,
    }
    try:
        if offload and mode is not Mode.CLOUD:
            raise DemoError(f"--offload needs containers: use it with --mode cloud, not --mode {mode}")
        if offload and slam:
            raise DemoError("--slam maps on the robot: use it without --offload")
        _check_replicas(replicas, mode)
        count = robots or (DEFAULT_ROBOTS if scen is None else DEFAULT_ROBOTS_OF_SCEN)
        floor = find_world(world)
        ways = find_lanes(lanes, floor.grid, slam=slam, blocked_cells=blocked_cells)
        fleet = _choose_fleet(count, full_stack, floor, seed, scen, ways)
        _refuse_light_robots(mode, offload=offload, slam=slam, light=fleet.has_light)
        _check_duration(duration, timeout, mode, headless=headless)
        if blocked_cells:
            _check_blocked(duration, headless=headless)
        if duration is not None and replicas == 1:  # else masters are killed, not the planner
            _check_kills(duration, count)
        if report is not None and headless:
            _check_report(report)
        if timeout is None:
            timeout = TIMEOUT + TIMEOUT_PER_ROBOT * max(0, count - MANY) + (duration or 0.0)
        ports = _choose_ports(headless, given, _needed_ports(mode, core_uri), replicas)
        with run_folder(state_dir) as folder:
            config = DemoConfig(
                fleet.scenario,
                seed,
                ports,
                folder,
                runtime=runtime.value if runtime is not None else "",
                offload=offload,
                mode=mode,
                core=core,
                core_uri=core_uri,
                machines=machines,
                blocked_cells=_count_blocked(blocked_cells, fleet, ways),
                slam=slam,
                full_stack=fleet.full_stack,
                robots_per_container=robots_per_container,
                duration=duration,
                tasks=tasks,
                world=fleet.world,
                replicas=replicas,
                lanes=ways,
            )
            show = typer.echo if verbose else _show_warning
            if headless:
                code = _run(_headless(config, timeout, report, show), stopped=1)
            else:
                code = _run(_with_page(config, show, auto=auto), stopped=0)
    except FleetError as error:
        typer.echo(f"rce demo: {error}", err=True)
        raise typer.Exit(1) from None
    raise typer.Exit(code)


class _Fleet(NamedTuple):
    """The robots of a demo, and where they are."""

    scenario: Scenario
    full_stack: int
    world: NamedWorld

    @property
    def has_light(self) -> bool:
        return self.full_stack < len(self.scenario.robots)


def _count_blocked(given: int | None, fleet: _Fleet, lanes: LaneGraph | None) -> int:
    """Return how many cells a run blocks."""
    if given is not None:
        return given
    return int(not fleet.has_light and lanes is None)


def _choose_fleet(
    count: int,
    full_stack: int | None,
    world: NamedWorld,
    seed: int,
    scen: Path | None,
    lanes: LaneGraph | None,
) -> _Fleet:
    """Choose scenario and kinds of robots; as the options say.

    Raises:
        DemoError: The scenario cannot be made.
    """
    if full_stack is None:
        full_stack = count if count <= MANY else 0
    if lanes is None:
        scenario = choose_scenario(count, seed, grid=world.grid, scen=scen)
    else:
        scenario = lane_scenario(count, seed, grid=world.grid, lanes=lanes, scen=scen)
        world = on_lanes(world, lanes)
    if full_stack < count and scenario.hidden_boxes:
        # Light robots have no sensors: the planner is told of all boxes.
        scenario = replace(scenario, known_boxes=tuple(sorted(scenario.boxes)), hidden_boxes=())
    return _Fleet(scenario, full_stack, world)


def _check_report(report: Path) -> None:
    """Raise DemoError if a report cannot be written at the end of the run."""
    if report.is_dir():
        raise DemoError(f"--report {report} is a folder: give a file")
    if not os.access(report if report.exists() else report.parent, os.W_OK):
        why = "cannot be written to" if report.parent.is_dir() else "is not in a folder that exists"
        raise DemoError(f"--report {report} {why}: give another file")


def _check_duration(duration: float | None, timeout: float | None, mode: Mode, *, headless: bool) -> None:
    """Raise DemoError if tasks cannot be streamed."""
    if duration is not None and timeout is not None and timeout <= duration:
        raise DemoError(
            f"--timeout {timeout:g} ends the run before its --duration of {duration:g} s: leave --timeout out"
        )
    if duration is not None and not headless:
        raise DemoError("--duration is for headless runs: add --headless")
    if duration is not None and mode is not Mode.CLOUD:
        raise DemoError(f"--duration kills the planner's container: use --mode cloud, not --mode {mode}")


def _check_blocked(duration: float | None, *, headless: bool) -> None:
    """Raise DemoError if the run blocks no cells."""
    if not headless:
        raise DemoError("--blocked-cells is for headless runs: add --headless")
    if duration is not None:
        raise DemoError("--blocked-cells is for runs in which each robot drives to one goal: omit --duration")


def _check_kills(duration: float, robots: int) -> None:
    """Raise DemoError if the planner cannot be killed as often as it must be while tasks are streamed."""
    from rce_fleet.demo.task_run import KILLS, shortest_run  # a demo with a page starts sooner without it

    least = shortest_run(robots)
    if duration < least:
        raise DemoError(
            f"--duration {duration:g} is too short to kill the planner {KILLS} times with {robots} robots: "
            f"give at least {least:g} s"
        )


def _check_replicas(replicas: int, mode: Mode) -> None:
    """Raise DemoError if so many masters cannot be run."""
    if replicas == 1:
        return
    if mode is not Mode.CLOUD:
        raise DemoError(f"--replicas needs the engine: use it with --mode cloud, not --mode {mode}")
    if replicas not in COUNTS:
        raise DemoError(f"--replicas must be 1, {' or '.join(map(str, COUNTS))}, found {replicas}")
    if shutil.which("etcd") is None:
        raise DemoError("etcd is not installed, which --replicas needs (Debian: etcd-server)")


def _refuse_light_robots(mode: Mode, *, offload: bool, slam: bool, light: bool) -> None:
    """Raise DemoError for options that need robots with localization and navigation of their own."""
    if not light:
        return
    reasons = {
        "--offload": offload,
        "--slam": slam,
        f"--mode {mode}": mode is not Mode.CLOUD,
    }
    given = ", ".join(name for name, is_given in reasons.items() if is_given)
    if given:
        raise DemoError(
            f"{given}: needs robots that run localization and navigation; take fewer robots, or set"
            " --full-stack to their number"
        )


def say(text: str) -> None:
    """Print a line for the user."""
    typer.echo(f"rce demo: {text}")


async def _headless(
    config: DemoConfig, timeout: float, report: Path | None, show: Callable[[str], None]
) -> int:
    from rce_fleet.demo.headless import run_headless  # a demo with a page starts sooner without it

    say(
        f"{len(config.scenario.robots)} robots, mode {config.mode}, seed {config.seed}, at most {timeout:g} s"
    )
    result = await run_headless(config, timeout, say, show)
    faults = result.faults
    if report is not None:
        try:
            result.write(report)
        except OSError as error:
            faults.append(f"the report {report} cannot be written: {error.strerror or error}")
    for fault in faults:
        typer.echo(f"rce demo: {fault}", err=True)
    if result.ok:
        say(result.summary)
    return 1 if faults else 0


async def _with_page(config: DemoConfig, show: Callable[[str], None], *, auto: bool) -> int:
    say(f"starting the fleet, mode {config.mode}")
    async with (
        start_demo(config, show, say) as demo,
        aiohttp.ClientSession() as session,
        AsyncExitStack() as stack,
    ):
        demo.group.enable_restarts(say)
        typer.echo(f"RCE demo: {demo.page}")
        if config.replicas > 1:
            from rce_fleet.demo.leader_key import KEY, leader_key  # other demos start sooner without it

            stack.enter_context(leader_key(config.master_urls, say))
            say(f"press {KEY} to kill the leading master")
        station = StationClient(session, demo.page)
        rng = Random(config.seed)  # noqa: S311 - for goals, not for secrets
        goals = RandomGoals(rng, None if config.lanes is None else config.goal_cells)
        works = [tell_speed(demo.truth, say), demo.keep_newcomers(say)]
        if auto:
            works.append(send_random_goals(station, goals, say, has_manager=config.mode is Mode.CLOUD))
        await demo.group.run_while_alive(_together(works))
    return 0


async def _together(works: Iterable[Coroutine[Any, Any, None]]) -> None:
    await asyncio.gather(*works)


def _run(work: Coroutine[Any, Any, int], *, stopped: int) -> int:
    """Run ``work`` until it returns or SIGINT or SIGTERM arrives; a second signal ends the program at once.

    Args:
        work: Returns the exit code.
        stopped: Exit code after a signal.
    """

    async def until_signal() -> int:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None

        def on_signal(number: signal.Signals) -> None:
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_DFL)
            task.cancel()

        for number in end_signals():
            loop.add_signal_handler(number, on_signal, number)
        try:
            return await work
        except asyncio.CancelledError:
            say("stopped")
            return stopped

    return uvloop.run(until_signal())


def _needed_ports(mode: Mode, core_uri: str) -> tuple[str, ...]:
    match mode:
        case Mode.CLOUD:
            return tuple(field.name for field in fields(Ports) if field.name != "core")
        case Mode.SINGLE:
            return ("page",) if core_uri else ("page", "core")
        case Mode.MULTI:
            return ("page",)
        case _:
            assert_never(mode)


def _choose_ports(
    headless: bool, given: dict[str, int | None], needed: Iterable[str], replicas: int
) -> Ports:
    """Return the ports to use; a headless run uses free ones for those without an option."""
    base = ANY if headless else Ports()
    chosen = {name: value for name, value in given.items() if value is not None}
    ports = Ports(**{name: getattr(base, name) for name in given} | chosen)
    return (ports if replicas == 1 else ports.in_rows(replicas)).choose(needed)


def _show_warning(line: str) -> None:
    """Print a program's line if it is a warning or an error."""
    if " WARNING " in line or " ERROR " in line:
        typer.echo(line, err=True)
