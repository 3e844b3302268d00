"""The command ``rce demo``."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import fields
from pathlib import Path
from random import Random
from typing import Annotated, Any, TypeVar

import aiohttp
import typer
import uvloop

from rce.cli.program_files import from_file
from rce.config.settings import Runtime
from rce.supervision.signals import end_signals
from rce_fleet.demo.config import CoreKind, DemoConfig, Machines, Mode
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import draw
from rce_fleet.demo.folder import run_folder
from rce_fleet.demo.headless import run_headless
from rce_fleet.demo.ports import ANY, Ports
from rce_fleet.demo.roaming import roam
from rce_fleet.demo.running import start_demo
from rce_fleet.demo.station import StationApi

ROBOTS, ROBOTS_OF_SCEN = 3, 4
MAX_ROBOTS = 99
TIMEOUT = 180.0

T = TypeVar("T")


@from_file("demo")
def demo(
    mode: Annotated[
        Mode, typer.Option(help="What carries the messages: the engine, one ROS core, or one per robot.")
    ] = Mode.CLOUD,
    headless: Annotated[
        bool, typer.Option("--headless", help="No page to look at: drive to goals once, report, exit.")
    ] = False,
    robots: Annotated[
        int | None, typer.Option(min=1, max=MAX_ROBOTS, help="Number of robots [3; 4 with --scen].")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Draws starts, goals, boxes and errors.")] = 0,
    timeout: Annotated[float, typer.Option(min=1, help="Seconds for a headless run.")] = TIMEOUT,
    report: Annotated[Path | None, typer.Option(help="File for the report of a headless run (JSON).")] = None,
    blocked_cells: Annotated[
        int, typer.Option(min=0, help="Block so many cells in a headless run; fewer where goals need them.")
    ] = 1,
    world: Annotated[
        Path | None, typer.Option(help="Drive on this map (MovingAI .map).", exists=True, dir_okay=False)
    ] = None,
    scen: Annotated[
        Path | None,
        typer.Option(help="Starts and goals on it (MovingAI .scen).", exists=True, dir_okay=False),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto/--no-auto", help="Send robots about until you send them.")
    ] = True,
    port: Annotated[int | None, typer.Option(help="The page [9080; headless: any].")] = None,
    http_port: Annotated[int | None, typer.Option(help="The engine's clients and REST [9000].")] = None,
    control_port: Annotated[int | None, typer.Option(help="Its task sets [8080].")] = None,
    ws_port: Annotated[int | None, typer.Option(help="Its robots' WebSockets [9010].")] = None,
    robot_link_port: Annotated[int | None, typer.Option(help="Its links to robot endpoints [10030].")] = None,
    container_link_port: Annotated[int | None, typer.Option(help="Its links to containers [10031].")] = None,
    runtime: Annotated[Runtime | None, typer.Option(help="How containers are isolated [auto].")] = None,
    core_port: Annotated[int | None, typer.Option(help="The ROS core of --mode single [11311].")] = None,
    core: Annotated[CoreKind, typer.Option(help="Which program it is.")] = CoreKind.RCE,
    core_uri: Annotated[
        str, typer.Option(help="A ROS master that runs already, in place of a core of its own.")
    ] = "",
    machines: Annotated[
        Machines, typer.Option(help="What stands for the machines of --mode multi.")
    ] = Machines.AUTO,
    state_dir: Annotated[
        Path | None, typer.Option(help="Keep configs, logs and state in a new folder in here.")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show what the programs print.")] = False,
) -> None:
    """Run a simulated fleet with its planner, on the engine or on ROS cores, and its page."""
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
        scenario = draw(robots or (ROBOTS if scen is None else ROBOTS_OF_SCEN), seed, world=world, scen=scen)
        ports = _choose_ports(headless, given, _needed_ports(mode, core_uri))
        with run_folder(state_dir) as folder:
            config = DemoConfig(
                scenario,
                seed,
                ports,
                folder,
                runtime=runtime.value if runtime is not None else "",
                mode=mode,
                core=core,
                core_uri=core_uri,
                machines=machines,
                blocked_cells=blocked_cells,
            )
            show = typer.echo if verbose else _show_warning
            if headless:
                code = _run(_headless(config, timeout, report, show), stopped=1)
            else:
                code = _run(_with_page(config, show, auto=auto), stopped=0)
    except DemoError as error:
        typer.echo(f"rce demo: {error}", err=True)
        raise typer.Exit(1) from None
    raise typer.Exit(code)


def say(text: str) -> None:
    """Tell the user something."""
    typer.echo(f"rce demo: {text}")


async def _headless(
    config: DemoConfig, timeout: float, report: Path | None, show: Callable[[str], None]
) -> int:
    say(
        f"{len(config.scenario.robots)} robots, mode {config.mode}, seed {config.seed}, at most {timeout:g} s"
    )
    result = await run_headless(config, timeout, say, show)
    if report is not None:
        result.write(report)
    for fault in result.faults:
        typer.echo(f"rce demo: {fault}", err=True)
    if result.ok:
        say(f"every robot is at its goal, {result.as_json()['duration_s']} s after it got it")
    return 0 if result.ok else 1


async def _with_page(config: DemoConfig, show: Callable[[str], None], *, auto: bool) -> int:
    say(f"starting the fleet, mode {config.mode}")
    async with start_demo(config, show) as demo, aiohttp.ClientSession() as session:
        demo.children.revive(say)
        typer.echo(f"RCE demo: {demo.page}")
        station = StationApi(session, demo.page)
        rng = Random(config.seed)  # noqa: S311 - draws goals, keeps no secret
        await demo.children.while_alive(roam(station, rng, say) if auto else _for_ever())
    return 0


async def _for_ever() -> None:
    await asyncio.Event().wait()


def _run(work: Coroutine[Any, Any, int], *, stopped: int) -> int:
    """Run until it is done, or SIGINT or SIGTERM came; a second signal ends this program at once.

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
        case Mode.SINGLE if not core_uri:
            return ("page", "core")
        case _:
            return ("page",)


def _choose_ports(headless: bool, given: dict[str, int | None], needed: Iterable[str]) -> Ports:
    """The ports to use; free ones where a headless run was not told which."""
    base = ANY if headless else Ports()
    chosen = {name: value for name, value in given.items() if value is not None}
    return Ports(**{name: getattr(base, name) for name in given} | chosen).chosen(needed)


def _show_warning(line: str) -> None:
    """Show a line of a program if it warns: that containers are not isolated, for instance."""
    if " WARNING " in line or " ERROR " in line:
        typer.echo(line, err=True)
