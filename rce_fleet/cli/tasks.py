"""``rce fleet task`` and ``rce fleet tasks``."""

from __future__ import annotations

import secrets
import time
from typing import TYPE_CHECKING, Annotated

import typer

from rce.printable import one_line
from rce_fleet.api.tasks import LoadRequest, RepeatModel, StopModel, TaskChange, TaskModel, TaskRequest
from rce_fleet.cli.access import STATION, AsJson, Station, checked, do, echo_json, echo_table
from rce_fleet.cli.times import read_moment
from rce_fleet.client import FleetApiUnavailableError

if TYPE_CHECKING:
    from rce_fleet.client import FleetClient

app = typer.Typer(no_args_is_help=True, help="Add, show, change, hold and cancel tasks.")

Deadline = Annotated[
    str, typer.Option(help="Seconds from now, or a local time such as 18:30 or 2026-11-28T18:30; 0: none.")
]
Id = Annotated[str, typer.Argument(metavar="TASK", help="Its id, as rce fleet tasks lists it.")]


def tasks(
    state: Annotated[
        str, typer.Option(help="States, separated by commas; also open, ended, recurring and all.")
    ] = "open",
    robot: Annotated[str, typer.Option(help="Only tasks that this robot does.")] = "",
    json_: AsJson = False,
    station: Station = STATION,
) -> None:
    """List tasks."""

    async def work(client: FleetClient) -> None:
        wanted = () if state == "all" else state.split(",")
        found = [task async for task in client.tasks(state=wanted, robot=robot)]
        if json_:
            echo_json(found)
            return
        rows = [_row(task) for task in found]
        echo_table(("task", "state", "robot", "target", "priority", "until", "what"), rows)

    do(station, work)


def _row(task: TaskModel) -> tuple[str, ...]:
    where = "-" if task.target is None else str(task.target)
    what = task.name or _stops(task.stops)
    notes = [task.reason] if task.reason else []
    if task.recurs_at is not None:
        notes.append(f"next {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(task.recurs_at))}")
    return (
        *(task.id, task.state, task.robot_assigned or "-", where, str(task.priority)),
        *(_clock(task.expected_end), f"{what} ({'; '.join(notes)})" if notes else what),
    )


def _stops(stops: list[StopModel]) -> str:
    return ", ".join(f"{stop.action} {_cells(stop)}".strip() for stop in stops)


def _cells(stop: StopModel) -> str:
    return str(stop.cell) if stop.cell is not None else "/".join(map(str, stop.cells))


def _clock(seconds: float | None) -> str:
    return "-" if seconds is None else time.strftime("%H:%M:%S", time.localtime(seconds))


@app.command("add")
def add(
    cell: Annotated[list[int] | None, typer.Option(help="Go to this cell; may be repeated.")] = None,
    pick: Annotated[int | None, typer.Option(help="Pick a load up here first.")] = None,
    deliver: Annotated[int | None, typer.Option(help="Deliver the load here at the end.")] = None,
    duration: Annotated[float, typer.Option(help="Seconds of each action.")] = 0.0,
    priority: Annotated[int, typer.Option(help="Larger numbers come first.")] = 0,
    deadline: Deadline = "",
    start: Annotated[
        str, typer.Option(help="No robot begins before; seconds from now or a time, as for --deadline.")
    ] = "",
    robot: Annotated[str, typer.Option(help="The only robot that may do it.")] = "",
    after: Annotated[list[str] | None, typer.Option(help="A task that must be done before.")] = None,
    rounds: Annotated[int, typer.Option(help="How often the stops are made.")] = 1,
    every: Annotated[
        float | None, typer.Option(help="Seconds from one occurrence to the next: the task recurs.")
    ] = None,
    count: Annotated[
        int | None, typer.Option(help="Occurrences in all, with --every (default: until cancelled).")
    ] = None,
    name: Annotated[str, typer.Option(help="For people.")] = "",
    key: Annotated[
        str,
        typer.Option(
            help="Your own key: the same key makes one task only. Repeat all options with it;"
            " --deadline and --start as dates, because seconds from now are another time then."
        ),
    ] = "",
    station: Station = STATION,
) -> None:
    """Create a task; print its id."""
    if pick is None and deliver is None and not cell:
        raise typer.BadParameter("say where: --cell CELL, or --pick CELL --deliver CELL")
    if count is not None and every is None:
        raise typer.BadParameter("say how often the task recurs: --every SECONDS", param_hint="count")
    now = time.time()
    with checked():
        stops = [StopModel(action="pick", cell=pick, duration=duration)] if pick is not None else []
        stops += [StopModel(cell=one, duration=duration) for one in cell or ()]
        if deliver is not None:
            stops.append(StopModel(action="deliver", cell=deliver, duration=duration))
        task = TaskRequest(
            stops=stops,
            name=name,
            rounds=rounds,
            priority=priority,
            deadline=read_moment(deadline, now, "--deadline"),
            earliest_start=read_moment(start, now, "--start"),
            robot=robot,
            after=after or [],
            repeat=None if every is None else RepeatModel(every=every, count=count),
        )

    used = key or secrets.token_hex(16)

    async def work(client: FleetClient) -> None:
        try:
            typer.echo((await client.create_task(task, key=used)).id)
        except FleetApiUnavailableError as error:
            again = f"to repeat the command without a second task, add --key {used}"
            raise FleetApiUnavailableError(f"{error}; {again}") from error

    do(station, work)


@app.command("show")
def show(task_id: Id, json_: AsJson = False, station: Station = STATION) -> None:
    """Show a task."""

    async def work(client: FleetClient) -> None:
        task = await client.task(task_id)
        if json_:
            echo_json(task)
            return
        echo_table(("task", "state", "robot", "target", "priority", "until", "what"), [_row(task)])
        for visit in task.visits:
            when = f"{_clock(visit.started_at)} to {_clock(visit.ended_at)}"
            typer.echo(f"stop {visit.stop}: {one_line(visit.robot)} in cell {visit.cell}, {when}")
        if task.question:
            answer = f"rce fleet task load {task_id} --cell CELL, or --lost"
            typer.echo(f"{one_line(task.question)} ({answer})")

    do(station, work)


@app.command("change")
def change(
    task_id: Id,
    priority: Annotated[int | None, typer.Option(help="Larger numbers come first.")] = None,
    deadline: Deadline = "",
    name: Annotated[str | None, typer.Option(help="For people.")] = None,
    station: Station = STATION,
) -> None:
    """Change a task, unless it is changed by others meanwhile."""
    changes: dict[str, object] = {}
    if priority is not None:
        changes["priority"] = priority
    if deadline:
        changes["deadline"] = read_moment(deadline, time.time(), "--deadline")
    if name is not None:
        changes["name"] = name
    if not changes:
        raise typer.BadParameter("say what to change, such as --priority 5")

    with checked():
        made = TaskChange.model_validate(changes)

    async def work(client: FleetClient) -> None:
        known = await client.task(task_id)
        task = await client.change_task(task_id, made, revision=known.revision)
        typer.echo(f"{task.id} is {task.state}, priority {task.priority}")

    do(station, work)


@app.command("hold")
def hold(
    task_id: Id,
    reason: Annotated[str, typer.Option(help="For people.")] = "",
    station: Station = STATION,
) -> None:
    """Hold a task."""

    async def work(client: FleetClient) -> None:
        task = await client.hold_task(task_id, reason)
        typer.echo(f"{task.id} is {task.state}")

    do(station, work)


@app.command("resume")
def resume(task_id: Id, station: Station = STATION) -> None:
    """End the hold of a task."""

    async def work(client: FleetClient) -> None:
        task = await client.resume_task(task_id)
        typer.echo(f"{task.id} is {task.state}")

    do(station, work)


@app.command("confirm")
def confirm(task_id: Id, station: Station = STATION) -> None:
    """Confirm the action that is under way."""

    async def work(client: FleetClient) -> None:
        task = await client.confirm_action(task_id)
        typer.echo(f"{task.id}: the action at stop {task.position} is confirmed")

    do(station, work)


@app.command("load")
def load(
    task_id: Id,
    cell: Annotated[int | None, typer.Option(help="Where the load is; a robot takes it there.")] = None,
    lost: Annotated[bool, typer.Option("--lost", help="The load is lost; the task fails.")] = False,
    station: Station = STATION,
) -> None:
    """Say where a load is whose robot does not come back."""
    if (cell is None) is not lost:
        raise typer.BadParameter("say where the load is: --cell CELL, or --lost")
    with checked():
        LoadRequest(cell=cell)

    async def work(client: FleetClient) -> None:
        task = await client.settle_load(task_id, cell)
        typer.echo(f"{task.id} is {task.state}")

    do(station, work)


@app.command("reassign")
def reassign(task_id: Id, station: Station = STATION) -> None:
    """Give a task to another robot."""

    async def work(client: FleetClient) -> None:
        task = await client.reassign_task(task_id)
        typer.echo(f"{task.id} is {task.state}")

    do(station, work)


@app.command("cancel")
def cancel(task_id: Id, station: Station = STATION) -> None:
    """Cancel a task, or the recurrence of one that has ended."""

    async def work(client: FleetClient) -> None:
        task = await client.cancel_task(task_id)
        typer.echo(f"{task.id} is {task.state}" + (", and does not recur" if task.repeat is not None else ""))

    do(station, work)


@app.command("cancel-many")
def cancel_many(
    requester: Annotated[str, typer.Option(help="Only tasks of this user.")] = "",
    state: Annotated[
        str, typer.Option(help="Only these states, separated by commas; also open, ended and recurring.")
    ] = "",
    robot: Annotated[str, typer.Option(help="Only tasks that this robot does.")] = "",
    station: Station = STATION,
) -> None:
    """Cancel all tasks of a user, of a robot, or in some states."""
    if not requester and not state and not robot:
        raise typer.BadParameter("say which tasks: --requester USER, --robot ROBOT, or --state open for all")

    async def work(client: FleetClient) -> None:
        wanted = list(filter(None, state.split(",")))
        cancelled = await client.cancel_tasks(state=wanted, robot=robot, requester=requester)
        typer.echo(f"{len(cancelled)} tasks are cancelled, or bring their loads away first")

    do(station, work)
