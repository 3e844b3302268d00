"""The promises of the fleet planner, under random delays, losses and speeds."""

from __future__ import annotations

from math import hypot
from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rce_fleet.coordination.events import CellBlocked, CellFreed, GoalSet, ModeSet, ZonesSet
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.zones import Direction, Zone, ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map, read_scenario

if TYPE_CHECKING:
    from pathlib import Path

    from unit.fleet.conftest import SimulatedClients


RADIUS = FleetSettings().robot_radius
JUMP_SETTLE_TIME = FleetSettings().jump_settle_time
FARTHER_THAN_IT_DRIVES = 5.0
"""Metres, although some poses get lost."""
STEPS_AT_REST = 300
"""Steps in which nothing changes, after which a run ends: half a minute."""
STOPPING_DISTANCE = 3.0
"""Metres in which a robot stops although messages are late and get lost."""


def connected_map(rng: Random, boxes: int) -> GridMap:
    while True:
        grid = GridMap().with_blocked(rng.sample(range(64), boxes))
        if grid.connected():
            return grid


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8))
@example(seed=332619, count=7)  # of two robots in a dead end, each comes out for the other, again and again
def test_every_robot_arrives_within_its_own_cells(
    make_fleet: type[SimulatedClients], seed: int, count: int
) -> None:
    rng = Random(seed)
    grid = connected_map(rng, 3)
    hidden = rng.choice(sorted(grid.blocked))
    known = grid.with_blocked(grid.blocked - {hidden})
    starts, goals = rng.sample(grid.free, count), rng.sample(grid.free, count)
    delays = rng.choice(((0.0,), (0.1, 0.5), (0.0, 3.0)))
    fleet = make_fleet(FleetPlanner(known), starts, seed, loss=rng.choice((0.0, 0.2)), plan_delays=delays)
    fleet.hidden = {hidden}
    fleet.send(goals)
    for _ in range(rng.randrange(60)):
        fleet.step()
    ahead = [cell for robot in fleet.planner.snapshot().robots for cell in robot.plan[1:]]
    candidates = [
        cell for cell in ahead if cell not in goals and grid.with_blocked(grid.blocked | {cell}).connected()
    ]
    if candidates:
        assert fleet.ask(CellBlocked(rng.choice(candidates))).ok
    fleet.run(fleet.all_arrived)
    assert {robot.id: robot.cell for robot in fleet.planner.snapshot().robots} == {
        f"Robot{number}": goal for number, goal in enumerate(goals, start=1)
    }


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8))
@example(seed=2271760180, count=1)  # a client begins behind a stop that is newer than all goals
def test_robots_stop_and_arrive_though_a_clock_jumps(
    make_fleet: type[SimulatedClients], seed: int, count: int
) -> None:
    """The clock of the machine of the move clients is set by up to an hour, again and again."""
    rng = Random(seed)
    grid = connected_map(rng, 3)
    starts, goals = rng.sample(grid.free, count), rng.sample(grid.free, count)
    fleet = make_fleet(FleetPlanner(grid), starts, seed, loss=rng.choice((0.0, 0.2)))
    fleet.send(goals)
    for _ in range(rng.randrange(4)):
        for _ in range(rng.randrange(40)):
            fleet.step()
        fleet.set_forward += rng.choice((-3600.0, -7.0, -0.5, 3600.0))
        if rng.random() < 0.3:
            fleet.restart_client(rng.choice(sorted(fleet.robots)))
        assert fleet.ask(ModeSet(None, RobotMode.STOPPED)).ok
        fleet.run(lambda: all(robot.current is None for robot in fleet.robots.values()), limit=10.0)
        assert fleet.ask(ModeSet(None, RobotMode.AUTOMATIC)).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8), carries=st.booleans())
@example(seed=1523888, count=2, carries=False)  # signs of life come before the poses of a silent time
@example(seed=900277, count=2, carries=True)  # a robot is pushed past the cell that it drives to
@example(seed=3607634174, count=5, carries=True)  # a robot is carried into the way of another
@example(seed=13712259, count=1, carries=True)  # a robot is pushed along its path, around a corner
@example(seed=48155, count=2, carries=True)  # a robot is pushed along its path before it takes the list
def test_indexes_equal_a_recomputation_whatever_happens(
    make_fleet: type[SimulatedClients], seed: int, count: int, carries: bool
) -> None:
    """After each step ``validate`` makes the indexes from scratch, and looks for what was left undone."""
    rng = Random(seed)
    grid = connected_map(rng, 3)
    starts = rng.sample(grid.free, count)
    delays = rng.choice(((0.0,), (0.1, 0.5), (0.0, 3.0)))
    fleet = make_fleet(FleetPlanner(grid), starts, seed, loss=0.1, plan_delays=delays)
    for _ in range(150):
        disturb(fleet, rng, carries=carries)
        fleet.step()
    fleet.silent.clear()
    fleet.mute.clear()
    assert fleet.ask(ZonesSet((), replace=True)).ok
    for robot in (None, *sorted(fleet.planner.state.robots)):
        assert fleet.ask(ModeSet(robot, RobotMode.AUTOMATIC)).ok
    for cell in sorted(fleet.blocked | fleet.planner.state.pending):
        assert fleet.ask(CellFreed(cell)).ok
    if fleet.robots:
        fleet.run(fleet.settled)
        assert fleet.send_all(rng.sample(grid.free, len(fleet.robots)))
        fleet.run(fleet.all_arrived)


@pytest.mark.slow
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(2, 6))
@example(seed=126, count=3)  # a robot that leaves the cell of another has its path through that cell
def test_robots_that_start_side_by_side_separate(
    make_fleet: type[SimulatedClients], seed: int, count: int
) -> None:
    """Several in one cell, and between cells. Where they are too near to each other they say so and stand."""
    rng = Random(seed)
    grid = connected_map(rng, 3)
    fleet = make_fleet(FleetPlanner(grid), [], seed, loss=rng.choice((0.0, 0.1)))
    for x, y in crowd(rng, grid, count):
        fleet.add_robot_at(f"Robot{len(fleet.robots) + 1}", x, y)
    fleet.run(lambda: len(fleet.states()) == len(fleet.robots))
    for robot, goal in zip(sorted(fleet.robots), rng.sample(grid.free, len(fleet.robots)), strict=True):
        assert fleet.ask(GoalSet(robot, goal)).ok
    robots, unchanged = fleet.planner.snapshot().robots, 0
    for _ in range(3000):
        fleet.step()
        if fleet.all_arrived():
            return
        before, robots = robots, fleet.planner.snapshot().robots
        unchanged = unchanged + 1 if robots == before else 0
        if unchanged == STEPS_AT_REST:
            break
    seen = " ".join(robot.reason for robot in robots)
    assert "drive one of them by hand" in seen or "is held by" in seen


def crowd(rng: Random, grid: GridMap, count: int) -> list[tuple[float, float]]:
    """Return places of robots that do not touch each other or walls, most of them side by side."""
    places: list[tuple[float, float]] = []
    for _ in range(5000):
        x, y = rng.uniform(RADIUS, 8 - RADIUS), rng.uniform(RADIUS, 8 - RADIUS)
        if places and rng.random() < 0.6:
            beside_x, beside_y = rng.choice(places)
            x, y = beside_x + rng.uniform(-0.6, 0.6), beside_y + rng.uniform(-0.6, 0.6)
        is_inside = min(x, y) >= RADIUS and max(x, y) <= 8 - RADIUS
        is_free = is_inside and not grid.cells_touched(x, y, RADIUS) & grid.blocked
        if is_free and all(hypot(x - a, y - b) > 2 * RADIUS + 0.05 for a, b in places):
            places.append((x, y))
        if len(places) == count:
            break
    return places


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(2, 8))
@example(seed=100000, count=7)  # the pose of a robot jumps while it is stopping between two cells
@example(seed=410003, count=8)  # a robot that is held gives a cell back that another one waits for
def test_robots_that_say_they_are_elsewhere_meet_no_other(
    make_fleet: type[SimulatedClients], seed: int, count: int
) -> None:
    """For shorter than poses have to agree. Longer, it looks as if the robots had been carried there."""
    rng = Random(seed)
    grid = connected_map(rng, 3)
    starts = rng.sample(grid.free, count)
    delays = rng.choice(((0.0,), (0.1, 0.5), (0.0, 3.0)))
    fleet = make_fleet(FleetPlanner(grid), starts, seed, loss=rng.choice((0.0, 0.1)), plan_delays=delays)
    fleet.send(rng.sample(grid.free, count))
    until: dict[str, float] = {}
    for _ in range(300):
        for robot in sorted(fleet.robots):
            if robot in until and fleet.now > until[robot]:
                del fleet.lies[robot], until[robot]
            elif robot not in until and rng.random() < 0.02:
                lie(fleet, rng, robot)
                until[robot] = fleet.now + rng.uniform(0.1, JUMP_SETTLE_TIME - 1.5)
            elif rng.random() < 0.01:
                fleet.ask(GoalSet(robot, rng.choice(grid.free)))
        fleet.step()
    fleet.lies.clear()
    fleet.run(fleet.settled)
    assert fleet.send_all(rng.sample(grid.free, count))
    fleet.run(fleet.all_arrived)


def lie(fleet: SimulatedClients, rng: Random, robot: str) -> None:
    """Let a robot say that it is far away: anywhere, in a wall, where another robot is, or beside the map."""
    body = fleet.robots[robot]
    while robot not in fleet.lies:
        x, y = rng.uniform(-3.0, 11.0), rng.uniform(-3.0, 11.0)
        if rng.random() < 0.3:
            other = fleet.robots[rng.choice(sorted(fleet.robots))]
            x, y = other.x, other.y
        if hypot(x - body.x, y - body.y) > FARTHER_THAN_IT_DRIVES:
            fleet.lies[robot] = x, y
        elif rng.random() < 0.1:
            fleet.lies[robot] = -30.0, 40.0


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(2, 6), pose_step=st.sampled_from((0.0, 0.2)))
def test_robots_driven_by_poses_that_end_meet_no_other(
    make_fleet: type[SimulatedClients], seed: int, count: int, pose_step: float
) -> None:
    """Their move clients answer nothing, poses get lost for a while, and so do lists and cancellations."""
    rng = Random(seed)
    grid = connected_map(rng, 3)
    fleet = make_fleet(FleetPlanner(grid), rng.sample(grid.free, count), seed, loss=0.0, pose_step=pose_step)
    fleet.mute = set(rng.sample(sorted(fleet.robots), count if pose_step else rng.randint(1, count)))
    fleet.run(fleet.settled)
    for _ in range(400):
        lose_messages(fleet, rng)
        fleet.step()
    fleet.unposed.clear()
    fleet.deaf.clear()
    for name in (None, *sorted(fleet.planner.state.robots)):
        assert fleet.ask(ModeSet(name, RobotMode.AUTOMATIC)).ok
    for cell in sorted(fleet.blocked | fleet.planner.state.pending):
        assert fleet.ask(CellFreed(cell)).ok
    for _ in range(200):
        fleet.step()
    if not pose_step:
        fleet.run(fleet.settled)
        assert fleet.send_all(rng.sample(grid.free, count))
        fleet.run(fleet.all_arrived)


def lose_messages(fleet: SimulatedClients, rng: Random) -> None:
    """Let poses of mute robots get lost or come again, or what they are told; and ask for something."""
    for robot in sorted(fleet.mute):
        if rng.random() < 0.02:
            fleet.unposed ^= {robot}
        if rng.random() < 0.02:
            fleet.deaf ^= {robot}
    what = rng.randrange(60)
    if what in (17, 18):
        change_rules(fleet, rng, what)
    elif what < 14:
        disturb(fleet, rng, carries=False, what=what)


def disturb(fleet: SimulatedClients, rng: Random, *, carries: bool, what: int = -1) -> None:
    """Let something happen, mostly nothing; if it ``carries``, also to robots whose move clients are mute."""
    robots = sorted(fleet.robots)
    what = rng.randrange(100) if what < 0 else what
    if what < 8 and robots:
        robot = rng.choice(robots)
        cell = rng.choice([None, *fleet.grid.free])
        if robot in fleet.planner.state.robots:
            fleet.ask(GoalSet(robot, cell))
    elif what < 11:
        cell = rng.choice(fleet.grid.free)
        if cell not in fleet.newcomers_cells():
            fleet.ask(CellBlocked(cell))
    elif what < 14 and fleet.blocked:
        fleet.ask(CellFreed(rng.choice(sorted(fleet.blocked))))
    elif what in ((14, 15, 16, 21) if carries else (14, 15, 16)) and robots:
        lose(fleet, rng.choice(robots), what)
    elif carries and 22 <= what < 30 and robots:
        carry(fleet, rng, rng.choice(robots))
    else:
        change_rules(fleet, rng, what)


def lose(fleet: SimulatedClients, robot: str, what: int) -> None:
    """Let a robot or its move client fall silent or be heard again, restart that, or take the robot away."""
    if what == 14:
        if robot in fleet.silent or fleet.planner.state.ledger.length(robot):  # others do not know it before
            fleet.silent ^= {robot}
    elif what == 21:
        fleet.mute ^= {robot}
    elif what == 15:
        fleet.restart_client(robot)
    elif len(fleet.robots) > 1 and robot in fleet.planner.state.robots:
        fleet.remove(robot)


def carry(fleet: SimulatedClients, rng: Random, robot: str) -> None:
    """Put a robot in others' ways, but near none, or push it, unless the planner would not see that."""
    body = fleet.robots[robot]
    ahead = [cell for other in fleet.planner.snapshot().robots for cell in other.plan[3:]]
    if ahead and rng.random() < 0.7:
        x, y = fleet.grid.centre(rng.choice(ahead))
        x, y = x + rng.uniform(-0.4, 0.4), y + rng.uniform(-0.4, 0.4)
    else:
        x, y = body.x + rng.uniform(-1.5, 1.5), body.y + rng.uniform(-1.5, 1.5)
    others = [other for other in fleet.robots.values() if other is not body]
    is_free = all(hypot(other.x - x, other.y - y) > STOPPING_DISTANCE for other in others)
    touched = fleet.grid.cells_touched(x, y, 0.3)
    state = fleet.planner.state
    taken = state.shut.union(*(state.ledger.claims(silent) for silent in fleet.silent | fleet.mute))
    is_inside = 0.3 <= x <= 7.7 and 0.3 <= y <= 7.7
    if is_inside and is_free and robot not in fleet.silent and not touched & taken:
        fleet.carry(robot, x, y)


def change_rules(fleet: SimulatedClients, rng: Random, what: int) -> None:
    """Change modes of robots or zones, mostly nothing."""
    robots = sorted(fleet.robots)
    if what in (17, 18) and robots:
        mode = rng.choice(
            [RobotMode.AUTOMATIC, RobotMode.AUTOMATIC, RobotMode.PAUSED, RobotMode.OUT_OF_SERVICE]
        )
        fleet.ask(ModeSet(rng.choice([None, *robots]) if mode.takes_goals else rng.choice(robots), mode))
    elif what in (19, 20):
        put_zone(fleet, rng)


def put_zone(fleet: SimulatedClients, rng: Random) -> None:
    """Make or remove a zone."""
    cells = tuple(sorted(set(rng.sample(fleet.grid.free, 3)) - fleet.newcomers_cells()))
    name = rng.choice("abc")
    zone = rng.choice(
        [
            Zone(name, ZoneKind.BLOCKED, cells, expires=fleet.now + 5.0),
            Zone(name, ZoneKind.BLOCKED, cells, robots=("Robot1", "Robot2")),
            Zone(name, ZoneKind.ONE_WAY, cells, direction=rng.choice(list(Direction))),
            Zone(name, ZoneKind.SLOW, cells, speed=0.2),
            Zone(name, ZoneKind.COST, cells, robots=("Robot1", "Robot3"), cost=7.0),
            Zone(name, ZoneKind.LIMITED, cells, capacity=1),
        ]
    )
    fleet.ask(ZonesSet((zone,) if cells and rng.random() < 0.7 else (), remove=(rng.choice("abc"),)))


@pytest.mark.slow
@pytest.mark.needs("data")
@pytest.mark.parametrize("count", [4, 12])
def test_robots_drive_on_a_benchmark_map(
    make_fleet: type[SimulatedClients], rce_data: Path, count: int
) -> None:
    grid = read_map(rce_data / "maps" / "random-32-32-20.map")
    rows = read_scenario(rce_data / "maps" / "random-32-32-20-random-1.scen", grid, limit=count)
    fleet = make_fleet(FleetPlanner(grid), [row.start for row in rows], seed=count)
    fleet.send([row.goal for row in rows])
    fleet.run(fleet.all_arrived)
