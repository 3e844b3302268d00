"""``rce fleet``: robots and events; tasks, zones, places and what is blocked have modules of their own."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Annotated

import typer

from rce.printable import for_terminal, one_line
from rce_fleet.cli import blocking, places, tasks, zones
from rce_fleet.cli.access import (
    STATION,
    AsJson,
    AsJsonLines,
    SendLogin,
    Station,
    Token,
    do,
    echo_json,
    echo_json_line,
    echo_table,
    set_token,
)
from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError
from rce_master.cli.exceptions import CliError

if TYPE_CHECKING:
    from rce_fleet.client import FleetClient

app = typer.Typer(no_args_is_help=True)
app.add_typer(tasks.app, name="task")
app.add_typer(zones.app, name="zone")
app.add_typer(places.app, name="place")
app.command("tasks")(tasks.tasks)


@app.callback()
def fleet(token: Token = "", send_login: SendLogin = False) -> None:
    """Control a fleet through its station."""
    set_token(token, sends_login=send_login)


Robot = Annotated[str, typer.Argument(help="The robot.")]
RobotOrAll = Annotated[str, typer.Argument(help="The robot; or --all.")]
All = Annotated[bool, typer.Option("--all", help="All robots.")]
Reason = Annotated[str, typer.Option(help="For people.")]


def _check_choice(robot: str, *, is_all: bool) -> None:
    """Check that a command names a robot, or all of them.

    Raises:
        typer.BadParameter: It names both or none.
    """
    if bool(robot) is is_all:
        raise typer.BadParameter("name one robot, or give --all")


@app.command("robots")
def robots(
    state: Annotated[str, typer.Option(help="States, separated by commas (default: all).")] = "",
    activity: Annotated[str, typer.Option(help="Activities, separated by commas (default: all).")] = "",
    json_: AsJson = False,
    station: Station = STATION,
) -> None:
    """List robots with their tasks and batteries."""

    async def work(client: FleetClient) -> None:
        found = await client.robots(states=_words(state), activities=_words(activity))
        if json_:
            echo_json(found)
            return
        rows = []
        for robot in found:
            battery = "-" if robot.battery is None else f"{robot.battery:.0%}"
            cell, goal = ("-" if number is None else str(number) for number in (robot.cell, robot.goal))
            task = " ".join(filter(None, (robot.task, *robot.queue))) or "-"
            rows.append((robot.id, robot.state, robot.activity, cell, goal, battery, task, robot.reason))
        echo_table(("robot", "state", "activity", "cell", "goal", "battery", "tasks", "reason"), rows)

    do(station, work)


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


@app.command("send")
def send(
    robot: Robot,
    cell: Annotated[int, typer.Option(help="Number of the cell.")],
    station: Station = STATION,
) -> None:
    """Send a robot to a cell by hand, without a task."""

    async def work(client: FleetClient) -> None:
        await client.send(robot, cell)
        typer.echo(f"{robot} goes to cell {cell}")

    do(station, work)


@app.command("stop")
def stop(robot: Robot, station: Station = STATION) -> None:
    """Stop a robot that was sent by hand."""

    async def work(client: FleetClient) -> None:
        await client.send(robot, None)
        typer.echo(f"{robot} stops")

    do(station, work)


@app.command("pause")
def pause(robot: RobotOrAll = "", all_: All = False, reason: Reason = "", station: Station = STATION) -> None:
    """Let a robot, or the whole fleet, stand still."""
    _check_choice(robot, is_all=all_)

    async def work(client: FleetClient) -> None:
        if all_:
            typer.echo(await client.set_mode("paused", reason) or "the fleet is paused")
        else:
            typer.echo(f"{robot} is {(await client.pause_robot(robot, reason)).activity}")

    do(station, work)


@app.command("resume")
def resume(robot: RobotOrAll = "", all_: All = False, station: Station = STATION) -> None:
    """End a robot's pause, emergency stop or manual mode, or the fleet's pause."""
    _check_choice(robot, is_all=all_)

    async def work(client: FleetClient) -> None:
        if all_:
            typer.echo(await client.set_mode("automatic") or "the fleet drives")
        else:
            typer.echo(f"{robot} is {(await client.resume_robot(robot)).activity}")

    do(station, work)


@app.command("emergency-stop")
def emergency_stop(
    robot: RobotOrAll = "",
    all_: All = False,
    release: Annotated[bool, typer.Option("--release", help="Release what was stopped.")] = False,
    station: Station = STATION,
) -> None:
    """Stop a robot, or all of them, at once and without the planner."""
    _check_choice(robot, is_all=all_)

    async def work(client: FleetClient) -> None:
        missed = await client.emergency_stop(robot, stopped=not release)
        if missed:
            raise CliError(
                f"not reached yet: {', '.join(map(one_line, missed))}; they get it when they come back"
            )
        typer.echo(f"{robot or 'all robots'}: {'released' if release else 'stopped'}")

    do(station, work)


@app.command("take-out")
def take_out(robot: Robot, reason: Reason = "", station: Station = STATION) -> None:
    """Take a robot out of service; others get its tasks."""

    async def work(client: FleetClient) -> None:
        typer.echo(f"{robot} is {(await client.take_out(robot, reason)).activity}")

    do(station, work)


@app.command("put-in")
def put_in(robot: Robot, station: Station = STATION) -> None:
    """Put a robot into service again."""

    async def work(client: FleetClient) -> None:
        typer.echo(f"{robot} is {(await client.put_in(robot)).activity}")

    do(station, work)


app.command("block")(blocking.block)
app.command("free")(blocking.free)


@app.command("watch")
def watch(
    after: Annotated[
        int | None, typer.Option(help="Begin after the event of this number (default: the newest).")
    ] = None,
    json_: AsJsonLines = False,
    station: Station = STATION,
) -> None:
    """Follow what happens until Ctrl-C."""

    async def work(client: FleetClient) -> None:
        number = after
        while True:
            try:
                async for event in client.events(number):
                    if json_:
                        echo_json_line(event)
                    else:
                        clock = time.strftime("%H:%M:%S", time.localtime(event.time))
                        text = one_line(event.text or f"{event.id}: {event.name}")
                        typer.echo(f"{event.number}  {clock}  {text}")
                    sys.stdout.flush()
            except EventsRestartedError as error:
                typer.echo(f"rce fleet: {error}", err=True)
                number = 0
            except EventsForgottenError as error:
                typer.echo(f"rce fleet: {error}", err=True)
                number = error.last

    do(station, work)


@app.command("history")
def history(
    hours: Annotated[float, typer.Option(help="How far back.", min=0.0)] = 24.0,
    kind: Annotated[
        str, typer.Option(help="Kinds of events, such as task,zone, separated by commas (default: all).")
    ] = "",
    robot: Annotated[str, typer.Option(help="Only events in which this robot took part.")] = "",
    json_: AsJsonLines = False,
    station: Station = STATION,
) -> None:
    """Print what happened as CSV."""

    async def work(client: FleetClient) -> None:
        since, kinds = max(0.0, time.time() - 3600.0 * hours), _words(kind)
        if json_:
            async for event in client.history(since=since, kinds=kinds, robot=robot):
                echo_json_line(event)
            return
        shows = for_terminal if sys.stdout.isatty() else str
        async for line in client.history_csv(since=since, kinds=kinds, robot=robot):
            typer.echo(shows(line), nl=False)

    do(station, work)


@app.command("statistics")
def statistics(
    hours: Annotated[float, typer.Option(help="How far back.", min=0.001)] = 1.0,
    json_: AsJson = False,
    station: Station = STATION,
) -> None:
    """Show what the fleet did."""

    async def work(client: FleetClient) -> None:
        found = await client.statistics(3600.0 * hours)
        if json_:
            echo_json(found)
            return
        rows = [(name, "-" if value is None else f"{value:g}") for name, value in found]
        echo_table(("figure", "value"), rows)

    do(station, work)
