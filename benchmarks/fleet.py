"""Measure the fleet planner: ``python -m benchmarks.fleet [--quick]``. It needs no engine.

``planner``: what a pose costs, by the number of robots; it should not depend on that. ``planning``: the
longest step of the event loop while plans are made by the process beside it, and how long a plan takes once
the process has started and has its compiled loops.
``bytes``: what the planner publishes and a page gets while robots drive, as whole states and as changes.

Times are those of the processor that the measured thread used, so that other load does not count.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
from dataclasses import dataclass, field
from math import ceil, sqrt
from random import Random
from time import perf_counter, thread_time
from typing import Any

import uvloop

from benchmarks.figures import Results, percentile, show
from rce.ros.packages import PackageIndex
from rce.ros.types import Time, TypeRegistry
from rce_fleet.compiled import is_available
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellsIgnored,
    Event,
    GoalSet,
    MakePlan,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan
from rce_fleet.nodes.plan_worker import PlanWorker, is_large
from rce_fleet.nodes.state_publisher import changes_fields, state_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.station.feed import Feed
from rce_fleet.station.view import FleetView, Pose

STARTED = Time(1)
SIZES = (50, 200, 800, 2000)
CELLS_PER_ROBOT = 5
BATCH = 2000
"""Poses of standing robots that are averaged."""
PLANS = 5
"""Plans whose time is measured."""
COMPILED_WITHIN_S = 120.0
POSE_LIMIT_US = 50
"""A pose should cost no more than this, however many robots there are."""


@dataclass
class Fleet:
    """A planner and robots that carry out commands at once, without any delay.

    Attributes:
        planner: The measured planner.
        now: Time of the fleet, seconds.
        requests: Requested plans that are not made yet.
    """

    planner: FleetPlanner
    now: float = 0.0
    requests: list[PlanRequest] = field(default_factory=list)
    revisions: dict[str, tuple[int, tuple[int, ...]]] = field(default_factory=dict)
    places: dict[str, tuple[float, float]] = field(default_factory=dict)

    def tell(self, event: Event) -> None:
        """Give an event to the planner."""
        for instruction in self.planner.handle(event, self.now):
            match instruction:
                case MakePlan(request):
                    self.requests.append(request)
                case SendCells(robot, revision, cells):
                    self.revisions[robot] = revision, cells
                case SendCancel() | Reply() | BlockedChanged() | CellsIgnored():
                    pass

    def pose(self, robot: str) -> PoseSeen:
        """The pose that a robot sends next."""
        return PoseSeen(robot, *self.places[robot], 0.0)

    def report(self, robot: str) -> ReportSeen:
        """Return the next message of a robot's move client."""
        revision, cells = self.revisions[robot]
        return ReportSeen(robot, ClientReport(revision, ClientState.IDLE, cells))

    def drive(self, robot: str) -> bool:
        """Put a robot into its next granted cell; return whether it has one."""
        granted = self.planner.state.ledger.granted(robot)
        if len(granted) > 1:
            self.places[robot] = self.planner.state.grid.centre(granted[1])
        return len(granted) > 1

    def say_all(self) -> None:
        """Send a message of every robot, so that the planner counts none as lost."""
        for robot in self.places:
            self.tell(self.pose(robot))
            self.tell(self.report(robot))
        self.tell(Tick())


def joined(count: int) -> Fleet:
    """Return a fleet of placed robots, each with a goal, and with a requested plan that is not made yet."""
    edge = ceil(sqrt(count * CELLS_PER_ROBOT))
    grid = GridMap(edge, edge)
    rng = Random(count)
    fleet = Fleet(FleetPlanner(grid))
    for number, cell in enumerate(rng.sample(range(edge * edge), count)):
        fleet.places[f"Robot{number}"] = grid.centre(cell)
    for robot in fleet.places:
        fleet.tell(fleet.pose(robot))
    while any(not fleet.planner.state.ledger.length(robot) for robot in fleet.places):
        fleet.now += 0.5
        fleet.say_all()
    for robot, goal in zip(fleet.places, rng.sample(range(edge * edge), count), strict=True):
        fleet.tell(GoalSet(robot, goal))
    return fleet


def finish_plans(fleet: Fleet) -> None:
    """Make all requested plans, and those that are requested because of them, one after another."""
    while True:
        if fleet.requests:
            fleet.tell(PlanMade(compute_plan(fleet.requests.pop())))
        fleet.tell(Tick())
        if not fleet.requests and not fleet.planner.is_taking_over():
            return


def pose_cost(count: int, *, batches: int) -> dict[str, Any]:
    """Measure the cost of a pose, of standing robots and of robots that enter their next cell with it."""
    fleet = joined(count)
    finish_plans(fleet)
    robots = list(fleet.places)
    rng = Random(count)
    driving = []
    while moving := [robot for robot in rng.sample(robots, count) if fleet.drive(robot)]:
        driving += [_timed(fleet, robot) for robot in moving]
        finish_plans(fleet)
        if len(driving) > batches * BATCH:
            break
    standing = [sum(_timed(fleet, rng.choice(robots)) for _ in range(BATCH)) / BATCH for _ in range(batches)]
    return {
        "robots": count,
        "standing, us per pose": round(1e6 * min(standing), 1),
        "driving, us per pose": round(1e6 * percentile(driving, 0.5), 1),
        "limit, us": POSE_LIMIT_US,
    }


def _timed(fleet: Fleet, robot: str) -> float:
    """Return the seconds that a robot's pose takes, without the plans that follow from it."""
    pose = fleet.pose(robot)
    began = thread_time()
    instructions = fleet.planner.handle(pose, fleet.now)
    took = thread_time() - began
    fleet.requests += [done.request for done in instructions if isinstance(done, MakePlan)]
    return took


async def _warm_up(worker: PlanWorker, request: PlanRequest) -> PlanResult:
    """Return a plan of the process that makes all later ones: the one with compiled loops, if they are used.

    Raises:
        TimeoutError: The loops are not compiled after two minutes.
    """
    result = await worker.compute(request)
    if is_available() and is_large(len(request.robots), request.rows * request.columns):
        async with asyncio.timeout(COMPILED_WITHIN_S):
            while not worker.is_compiled:  # noqa: ASYNC110 - it has no event
                await asyncio.sleep(0.1)
        result = await worker.compute(request)
    return result


async def plan_cost(count: int) -> dict[str, Any]:
    """The longest step of the event loop while plans are made, with a pose in each other step."""
    fleet = joined(count)
    for robot in fleet.places:
        fleet.tell(fleet.report(robot))
    gc.collect()
    gc.freeze()
    async with PlanWorker(logging.getLogger("benchmark")) as worker:
        # This plan has the first goal only; the next one has all of them.
        fleet.tell(PlanMade(await _warm_up(worker, fleet.requests.pop())))
        while not fleet.requests:
            fleet.tell(Tick())
        request = fleet.requests.pop()
        steps: dict[str, float] = {}

        def step(name: str, event: Event) -> None:
            began = thread_time()
            fleet.tell(event)
            steps[name] = max(steps.get(name, 0.0), thread_time() - began)

        async def feed() -> None:
            robots = list(fleet.places)
            while True:
                for robot in robots:
                    step("pose", fleet.pose(robot))
                    await asyncio.sleep(0)
                step("tick", Tick())

        feeding = asyncio.create_task(feed())
        took = []
        for _ in range(PLANS):
            began = perf_counter()
            result = await worker.compute(request)
            took.append(perf_counter() - began)
        step("plan", PlanMade(result))
        while fleet.planner.is_taking_over():
            step("plan", Tick())
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)
    gc.unfreeze()
    return {
        "robots": count,
        "plan s": round(percentile(took, 0.5), 3),
        "longest step ms": round(1e3 * max(steps.values()), 2),
        **{f"{name} ms": round(1e3 * steps.get(name, 0.0), 2) for name in ("pose", "tick", "plan")},
    }


class Traffic:
    """Robots that drive a cell every two seconds, and the traffic of the planner and the station.

    Attributes:
        spent: Bytes so far: from the planner as whole states and as changes, to one page likewise.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.spent = dict.fromkeys(("planner, whole", "planner, changes", "page, whole", "page, changes"), 0)
        self._fleet = fleet
        rng = Random(len(fleet.places))
        self._progress = {robot: rng.random() for robot in fleet.places}
        types = TypeRegistry(PackageIndex([]))
        self._state, self._changes = types.message("fleet/FleetState"), types.message("fleet/FleetChanges")
        self._view = FleetView()
        self._feed = Feed(self._view)
        self._page = self._feed.pages.open()
        fleet.planner.take_changes()
        self._feed.on_change(self._view.on_state(state_fields(STARTED, fleet.planner)))

    async def run(self, seconds: int) -> None:
        """Drive."""
        await self._tick()
        self.spent = dict.fromkeys(self.spent, 0)  # The page has the whole state now.
        for _ in range(seconds * 10):
            await self._tick()

    async def _tick(self) -> None:
        """A tenth of a second."""
        fleet = self._fleet
        fleet.now += 0.1
        for robot in fleet.places:
            self._move(robot)
            fleet.tell(fleet.report(robot))
        fleet.tell(Tick())
        finish_plans(fleet)
        self._publish()
        self._feed.send_poses(fleet.now)
        self._feed.on_event("", "")  # produces the next changes
        self.spent["page, changes"] += sum(map(len, (await self._page.take())[:-1]))

    def _move(self, robot: str) -> None:
        fleet = self._fleet
        grid, granted = fleet.planner.state.grid, fleet.planner.state.ledger.granted(robot)
        self._progress[robot] += 0.05
        if len(granted) < 2:
            self._progress[robot] = 0.0
        (x, y), (to_x, to_y) = grid.centre(granted[0]), grid.centre(granted[min(1, len(granted) - 1)])
        share = min(self._progress[robot], 1.0)
        self._progress[robot] %= 1.0
        fleet.places[robot] = x + share * (to_x - x), y + share * (to_y - y)
        fleet.tell(fleet.pose(robot))
        self._view.poses[robot] = Pose(*fleet.places[robot], 0.0)
        self._feed.on_pose(robot)

    def _publish(self) -> None:
        fleet, view, spent = self._fleet, self._view, self.spent
        poses = {robot: (round(p.x, 3), round(p.y, 3), round(p.theta, 3)) for robot, p in view.poses.items()}
        spent["page, whole"] += 2 * len(json.dumps({"type": "poses", "poses": poses}))
        changes = fleet.planner.take_changes()
        if changes is None:
            return
        whole = state_fields(STARTED, fleet.planner)
        fields = changes_fields(STARTED, changes, changes.sequence)
        spent["planner, whole"] += len(self._state.serialize(self._state.new(**whole)))
        spent["planner, changes"] += len(self._changes.serialize(self._changes.new(**fields)))
        self._feed.on_change(view.on_changes(fields))
        shown = {"type": "state", "robots": view.robots(), "blocked": view.blocked(), "pending": []}
        spent["page, whole"] += len(json.dumps(shown)) + len(
            json.dumps({"type": "map", **(view.map() or {})})
        )


async def byte_rates(count: int, *, seconds: int) -> dict[str, Any]:
    """Bytes a second while robots drive, from the planner and to one page.

    ``whole`` is what it was before there were changes: the state ten times a second, and to a page also the
    map and, twenty times a second, all poses.
    """
    fleet = joined(count)
    finish_plans(fleet)
    traffic = Traffic(fleet)
    await traffic.run(seconds)
    return {
        "robots": count,
        **{f"{what}, kB/s": round(spent / seconds / 1e3, 1) for what, spent in traffic.spent.items()},
    }


async def measure(*, quick: bool) -> None:
    """Run all suites."""
    sizes = SIZES[:2] if quick else SIZES
    results = Results("fleet", quick=quick)
    poses = [pose_cost(count, batches=3 if quick else 10) for count in sizes]
    results.keep("planner", poses)
    show("Cost of a pose", poses)
    results.begin("planning")
    plans = [await plan_cost(count) for count in sizes]
    results.keep("planning", plans)
    show("Event loop while a plan is made", plans)
    results.begin("bytes")
    rates = [await byte_rates(count, seconds=5 if quick else 10) for count in sizes[:3]]
    results.keep("bytes", rates)
    show("Bytes a second while robots drive", rates)
    print("results:", results.save())


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small fleets only")
    uvloop.run(measure(quick=parser.parse_args().quick))


if __name__ == "__main__":
    main()
