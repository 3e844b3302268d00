"""The routes of robots, map, statistics and events; and those of places and zones."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import asdict, replace
from itertools import islice
from typing import get_args

from rce_fleet.api.fleet import (
    CellBlockModel,
    EventModel,
    EventPage,
    FleetMapModel,
    FleetModeChange,
    FleetRobotModel,
    GoalAnswer,
    GoalChange,
    LaneModel,
    RobotChange,
    RobotList,
)
from rce_fleet.api.tasks import HoldRequest, PutInRequest
from rce_fleet.api.webhooks import EventKind
from rce_fleet.exceptions import PlannerSilentError, TaskRefusedError, UnknownTaskError
from rce_fleet.journal.journal import EventQuery
from rce_fleet.manager.convert import read_profile, show_profile
from rce_fleet.manager.goals import NO_ANSWER
from rce_fleet.manager.place_routes import ROUTES as PLACE_ROUTES
from rce_fleet.manager.place_routes import check_cells
from rce_fleet.manager.planner_sync import SetMode
from rce_fleet.manager.requests import BadRequestError, Call, FleetAnswer, Route, problem, shown
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.loads import carried
from rce_fleet.tasks.records import AUTOMATIC, RobotEntry

MOST_EVENTS = 5000
MOST_ROBOTS = 1000
"""In one page."""
MOST_VERSION = 1 << 53
"""Greatest version of the list of robots, which JavaScript can tell from the next one."""
_OF_EVENTS = ("id", "kind", "robot")
"""What events can be asked for by."""


# Robots


async def robots(call: Call) -> FleetAnswer:
    """Return robots by name: all, or a page of them; of some states or activities only; or changed ones."""
    call.only("limit", "cursor", "state", "activity", "since")
    if "since" in call.query:
        return _changed_robots(call)
    limit, after = call.count("limit", 0, MOST_ROBOTS), call.query.get("cursor", "")
    names = sorted(name for name in {*call.manager.facts.robots, *call.manager.book.robots} if name > after)
    wanted = {field: text.split(",") for field in ("state", "activity") if (text := call.query.get(field))}
    queues = _queues(call)
    found = (_show_robot(call, name, queues) for name in names)
    fitting = (robot for robot in found if all(getattr(robot, field) in wanted[field] for field in wanted))
    page = list(islice(fitting, limit or None))
    more = next(fitting, None) is not None
    return shown(RobotList(robots=page, next=page[-1].id if more else None))


def _changed_robots(call: Call) -> FleetAnswer:
    """Return the robots of which something else than place and state changed since a version."""
    if len(call.query) > 1:
        raise BadRequestError("since goes with no other parameter")
    since, manager, queues = call.count("since", 0, MOST_VERSION), call.manager, _queues(call)
    names = sorted({*manager.facts.robots, *manager.book.robots})
    changed = manager.robot_changes.since(since, {name: _what_changes(call, name, queues) for name in names})
    shows = [_show_robot(call, name, queues) for name in changed]
    return shown(RobotList(robots=shows, version=manager.robot_changes.version))


def _what_changes(call: Call, name: str, queues: dict[str, list[str]]) -> Hashable:
    """Return what a page shows of a robot beside what it has from the planner."""
    manager = call.manager
    facts = manager.facts.robots.get(name)
    entry, task = manager.book.entry(name), manager.book.task_of(name)
    return (
        None if facts is None else (facts.by_hand, facts.battery and round(facts.battery, 2)),
        manager.dispatcher.activity(name),
        (entry.mode, entry.reason, entry.revision),
        None if task is None else (task.id, *carried(task)),
        tuple(queues.get(name, ())),
    )


async def robot(call: Call) -> FleetAnswer:
    """Return a robot."""
    name = _robot(call)
    return _robot_answer(call, name)


async def change_robot(call: Call) -> FleetAnswer:
    """Change a robot's profile."""
    model = call.model(RobotChange)
    profile = None if model.profile is None else read_profile(model.profile)
    name, entry = _entry(call)
    if profile != entry.profile:
        changed = replace(entry, profile=profile, revision=entry.revision + 1)
        call.manager.book.emit(changed, "profile", call.now, user=call.request.user, text=f"{name}: profile")
    await call.manager.commit()  # also if another request just set it: that may not be in the journal yet
    return _robot_answer(call, name)


async def pause(call: Call) -> FleetAnswer:
    """Let a robot stand still; it keeps its task."""
    reason = call.model(HoldRequest).reason
    return await _set_mode(call, "paused", "paused", reason, unless_out=True)


async def resume(call: Call) -> FleetAnswer:
    """Let the planner drive a robot again that was paused, stopped or driven by hand."""
    return await _set_mode(call, AUTOMATIC, "resumed", unless_out=True)


async def take_out(call: Call) -> FleetAnswer:
    """Take a robot out of service: others get its tasks, but not its load."""
    return await _set_mode(call, "out_of_service", "taken out", call.model(HoldRequest).reason)


async def put_in(call: Call) -> FleetAnswer:
    """Put a robot into service again; one that shall stand never drives in between."""
    model = call.model(PutInRequest)
    return await _set_mode(call, model.mode, "put in", model.reason if model.mode != AUTOMATIC else "")


async def set_fleet_mode(call: Call) -> FleetAnswer:
    """Pause the fleet, or let it drive; if the planner refuses, it stays as it was."""
    model, manager = call.model(FleetModeChange), call.manager
    refusal = await manager.set_fleet_mode(model.mode, model.reason, call.request.user)
    if refusal.startswith(NO_ANSWER):
        return problem(503, refusal)
    if refusal:
        raise TaskRefusedError(refusal)
    return shown(GoalAnswer(message=f"the fleet is {model.mode}"))


async def set_goal(call: Call) -> FleetAnswer:
    """Send a robot to a cell, or let it stop; if the planner refuses, its goal stays as it was."""
    name, cell, manager = _robot(call), call.model(GoalChange).cell, call.manager
    check_cells(call, () if cell is None else (cell,))
    refusal = await manager.set_goal(name, cell, call.request.user)
    if refusal.startswith(NO_ANSWER):
        return problem(503, refusal)
    if refusal:
        raise TaskRefusedError(refusal)
    text = f"{name} stops" if cell is None else f"{name} goes to cell {cell}"
    return shown(GoalAnswer(message=text))


def _robot(call: Call) -> str:
    name, manager = call.names[0], call.manager
    if name in manager.facts.robots or name in manager.book.robots:
        return name
    if manager.facts.grid is None:
        raise PlannerSilentError("the planner has not told its robots yet; try again later")
    raise UnknownTaskError(f"there is no robot {name!r}")


def _entry(call: Call) -> tuple[str, RobotEntry]:
    """Return a robot's name, and what people decided about it."""
    name = _robot(call)
    entry = call.manager.book.entry(name)
    call.check_revision(name, entry.revision)
    return name, entry


async def _set_mode(
    call: Call, mode: str, what: str, reason: str = "", *, unless_out: bool = False
) -> FleetAnswer:
    """Set who drives a robot; if the planner refuses, its mode stays."""
    manager, user = call.manager, call.request.user
    async with manager.changes.hold("mode", _robot(call)):
        name, entry = _entry(call)
        if unless_out and entry.is_out:
            raise TaskRefusedError(f"{name} is out of service: put it in")
        if (entry.mode, entry.reason) == (mode, reason):
            await manager.commit()  # it may not be in the journal yet
            return _robot_answer(call, name)
        changed = replace(
            entry, mode=mode, reason=reason, user=user, revision=entry.revision + 1, unsent=True
        )
        text = f"{name}: {what}" + (f", {reason}" if reason else "")
        manager.book.emit(changed, what, manager.clock(), user=user, text=text)
        await manager.commit()
        robot = manager.facts.robots.get(name)
        is_known = robot is not None and robot.is_known
        refusal = await manager.tell(SetMode(name, mode, reason, user)) if is_known else ""
        if refusal and not refusal.startswith(NO_ANSWER):
            if manager.book.entry(name) == changed:
                back = replace(entry, revision=changed.revision + 1)
                manager.book.emit(back, entry.mode, manager.clock(), text=f"{name}: {refusal}")
                await manager.commit()
            raise TaskRefusedError(refusal)
    return _robot_answer(call, name)


def _robot_answer(call: Call, name: str) -> FleetAnswer:
    shows = _show_robot(call, name, _queues(call))
    return shown(shows, revision=shows.revision)


def _queues(call: Call) -> dict[str, list[str]]:
    return {robot: [task.id for task in tasks] for robot, tasks in call.manager.book.queues().items()}


def _show_robot(call: Call, name: str, queues: dict[str, list[str]]) -> FleetRobotModel:
    manager = call.manager
    facts = manager.facts.robots.get(name) or RobotFacts(name, "away", "the planner does not know it")
    entry: RobotEntry = manager.book.entry(name)
    task = manager.book.task_of(name)
    activity = manager.dispatcher.activity(name)
    return FleetRobotModel(
        id=name,
        state=facts.state,
        activity="by hand" if facts.by_hand and activity == "idle" else activity,
        reason=entry.reason or facts.reason or manager.dispatcher.chargers.waiting.get(name, ""),
        cell=facts.cell,
        goal=facts.goal,
        battery=facts.battery,
        task=None if task is None else task.id,
        queue=queues.get(name, []),
        loads=[] if task is None else list(carried(task)),
        profile=show_profile(manager.dispatcher.profile(name)),
        mode=entry.mode,
        mode_reason=entry.reason,
        revision=entry.revision,
    )


# Map, figures, events


async def fleet_map(call: Call) -> FleetAnswer:
    """Return the grid; a cell that was just blocked or freed is shown so before the planner tells it."""
    grid, kept = call.manager.facts.grid, call.manager.book.blocked
    lanes = call.manager.facts.lanes
    if grid is None:
        return problem(503, "the planner has not told its map yet; try again later")
    present = {cell for cell in kept.cells if cell in grid and not kept.block(cell).has_ended(call.now)}
    freed = {*kept.unsent}.difference(kept.cells)
    blocked = ({*call.manager.facts.shut, *present} - grid.blocked).difference(freed)
    own = {cell: kept.blocks[cell] for cell in present & kept.blocks.keys()}
    blocks = {**call.manager.facts.blocks, **own}
    return shown(
        FleetMapModel(
            rows=grid.rows,
            columns=grid.columns,
            cell_size=grid.cell_size,
            origin=list(grid.origin),
            yaw=grid.yaw,
            walls=sorted(grid.blocked),
            blocked=sorted(blocked),
            blocks=[
                CellBlockModel(cell=cell, **asdict(blocks[cell])) for cell in sorted(blocks.keys() & blocked)
            ],
            lanes=[LaneModel.model_validate(asdict(lane)) for lane in lanes.lanes] if lanes else [],
        )
    )


async def statistics(call: Call) -> FleetAnswer:
    """Return what the fleet did in the last seconds."""
    call.only("seconds")
    seconds = call.number("seconds", 3600.0, 1.0, 366 * 86400.0)
    if seconds is None:
        raise BadRequestError("seconds must be a number")
    manager = call.manager
    known_since = manager.known_since()
    return shown(manager.statistics.show(call.now, seconds, manager.facts, manager.book, known_since))


async def events(call: Call) -> FleetAnswer:
    """Return events after a number."""
    call.only("after", "limit", *_OF_EVENTS)
    return await _page(call, _event_query(call))


async def history(call: Call) -> FleetAnswer:
    """Return events of a time."""
    call.only("since", "until", "after", "limit", *_OF_EVENTS)
    since, until = call.number("since", None), call.number("until", None)
    return await _page(call, replace(_event_query(call), since=since, until=until))


def _event_query(call: Call) -> EventQuery:
    """Return which events are asked for.

    Raises:
        BadRequestError: The kind is unknown, or a number is wrong.
    """
    kinds = tuple(filter(None, call.query.get("kind", "").split(",")))
    known = get_args(EventKind)
    if unknown := sorted({*kinds} - {*known}):
        raise BadRequestError(f"unknown kind {unknown[0]!r}; possible are {', '.join(known)}")
    return EventQuery(
        after=call.count("after", 0, 10**17),
        id=call.query.get("id", ""),
        limit=call.count("limit", 1000, MOST_EVENTS),
        kinds=kinds,
        robot=call.query.get("robot", ""),
    )


async def _page(call: Call, query: EventQuery) -> FleetAnswer:
    found = await call.manager.events(query)
    following = found[-1]["number"] if found else query.after
    manager = call.manager
    models = [EventModel(**event) for event in found]
    return shown(EventPage(events=models, next=following, journal=manager.journal_id, newest=manager.written))


ROUTES = [
    Route("GET", "/robots", robots),
    Route("GET", "/robots/{id}", robot),
    Route("GET", "/robots/{id}/manager", robot),
    Route("PATCH", "/robots/{id}", change_robot, changes=True),
    Route("POST", "/robots/{id}/pause", pause, changes=True),
    Route("POST", "/robots/{id}/resume", resume, changes=True),
    Route("POST", "/robots/{id}/take-out", take_out, changes=True),
    Route("POST", "/robots/{id}/put-in", put_in, changes=True),
    Route("PUT", "/robots/{id}/goal", set_goal, changes=True),
    Route("PUT", "/mode", set_fleet_mode, changes=True),
    Route("GET", "/map", fleet_map),
    Route("GET", "/statistics", statistics),
    Route("GET", "/events", events),
    Route("GET", "/history", history),
    *PLACE_ROUTES,
]
