"""Frontiers, the choice of goals, and whole explorations with an ideal sensor."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.distance import distance_field
from rce_fleet.maps.occupancy_map import UNKNOWN, OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays
from rce_fleet.navigation.exploration.explorer import MAP_WAIT, Action, Explorer, ExplorerParameters
from rce_fleet.navigation.exploration.frontiers import (
    EXTENT,
    REACH,
    FrontierParameters,
    FrontierSearch,
    find_frontiers,
)

CELL = 0.1
RADIUS = 0.2
PARAMETERS = ExplorerParameters(min_frontier_size=0.3, potential_scale=3.0, robot_radius=RADIUS)


def picture(*lines: str, cell: float = CELL) -> OccupancyMap:
    """Return a map drawn with ``#``, ``.`` and ``?`` (unknown); the last line has the lowest y."""
    values = {"#": 100, ".": 0, "?": UNKNOWN}
    rows = [[values[sign] for sign in line] for line in reversed(lines)]
    return OccupancyMap(np.array(rows, np.int8), cell)


def floor_of(seed: int, size: int = 50) -> OccupancyMap:
    """Return a closed floor with random walls and boxes."""
    rng = np.random.default_rng(seed)
    data = np.zeros((size, size), np.int8)
    data[[0, -1]], data[:, [0, -1]] = 100, 100
    for _ in range(int(rng.integers(2, 7))):
        row, column = rng.integers(1, size - 1, 2)
        if rng.random() < 0.5:
            data[row : row + int(rng.integers(2, 25)), column] = 100
        else:
            height, width = rng.integers(2, 12, 2)
            data[row : row + height, column : column + width] = 100
    return OccupancyMap(data, CELL)


def seen_from(truth: OccupancyMap, known: OccupancyMap, pose: Pose, reach: float) -> OccupancyMap:
    """Return the known map after a scan with an ideal sensor that sees all around."""
    angles = np.linspace(-pi, pi, 720, endpoint=False)
    at = np.array((pose.x, pose.y))
    ranges = cast_rays(truth, at, angles, reach)
    steps = np.arange(0.0, reach, CELL / 3)
    rays = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    points = at + steps[:, None, None] * rays
    free = truth.world_to_cell(points[steps[:, None] < ranges])
    ends = truth.world_to_cell((at + (ranges + 1e-6)[:, None] * rays)[ranges < reach])
    data = known.data.copy()
    data[tuple(free[truth.inside(free)].T)] = 0
    ends = ends[truth.inside(ends)]
    hit = truth.occupied[tuple(ends.T)]
    data[tuple(ends[hit].T)] = 100
    return OccupancyMap(data, CELL)


def explore(truth: OccupancyMap, pose: Pose, reach: float) -> tuple[OccupancyMap, Explorer]:
    """Explore a floor; the robot is put at each goal."""
    explorer, now = Explorer(PARAMETERS), 0.0
    known = OccupancyMap(np.full_like(truth.data, UNKNOWN), CELL)
    while True:
        known = seen_from(truth, known, pose, reach)
        now += 1.0
        action = explorer.update(find_frontiers(known, pose, PARAMETERS), now, now)
        if action is Action.DONE:
            return known, explorer
        if action is Action.DRIVE:
            assert explorer.target is not None
            pose = explorer.target.goal
            assert not truth.occupied[tuple(truth.world_to_cell((pose.x, pose.y)))]
            known = seen_from(truth, known, pose, reach)
            explorer.reached(now)
        assert explorer.goals < 500


def roomy_start(truth: OccupancyMap) -> Pose:
    """Return a place with room."""
    roomy = truth.cell_to_world(np.argwhere(distance_field(truth) > RADIUS + CELL))
    x, y = roomy[len(roomy) // 3]
    return Pose(float(x), float(y), 0.3)


# Frontiers


def test_a_frontier_is_where_free_meets_unknown() -> None:
    known = picture("##########", "#......???", "#......???", "#......???", "#......???", "##########")
    (found,) = find_frontiers(known, Pose(0.25, 0.25, 0.0), replace(PARAMETERS, robot_radius=0.1)).frontiers
    assert sorted(map(tuple, np.round(found.points, 2))) == [
        (0.65, 0.15),
        (0.65, 0.25),
        (0.65, 0.35),
        (0.65, 0.45),
    ]
    assert found.size == pytest.approx(0.4)
    assert found.goal.yaw == pytest.approx(0.0, abs=0.8)
    assert found.way == pytest.approx(hypot(found.goal.x - 0.25, found.goal.y - 0.25), abs=0.1)


def test_a_map_without_unknown_cells_has_no_frontier() -> None:
    search = find_frontiers(
        picture("####", "#..#", "#..#", "####"), Pose(0.15, 0.15, 0), FrontierParameters()
    )
    assert (search.frontiers, search.unreachable, search.reason) == ((), (), "")


def test_short_frontiers_are_ignored() -> None:
    known = picture("#######", "#.....?", "#.....?", "#.....#", "#######")
    assert find_frontiers(known, Pose(0.2, 0.2, 0.0), FrontierParameters(0.25)).frontiers == ()
    assert len(find_frontiers(known, Pose(0.2, 0.2, 0.0), FrontierParameters(0.2)).frontiers) == 1


def test_a_frontier_behind_a_narrow_gap_is_unreachable() -> None:
    """The robot has to stand farther from it than it may; with a smaller radius it drives through."""
    row = "#" + "." * 10 + "." * 12 + "?"
    wall = "#" + "." * 10 + "#" * 12 + "?"
    known = picture("#" * 24, *[wall] * 4, row, row, row, *[wall] * 4, "#" * 24)
    wide = find_frontiers(known, Pose(0.5, 0.55, 0.0), replace(PARAMETERS, robot_radius=0.3))
    assert (len(wide.frontiers), len(wide.unreachable)) == (0, 1)
    slim = find_frontiers(known, Pose(0.5, 0.55, 0.0), replace(PARAMETERS, robot_radius=0.12))
    assert (len(slim.frontiers), len(slim.unreachable)) == (1, 0)


def test_a_frontier_behind_a_thin_wall_is_unreachable() -> None:
    """It is near, but the robot does not see it from where it can stand."""
    known = picture("#########", "#....#..?", "#....#..?", "#....#..?", "#....#..?", "#########")
    search = find_frontiers(known, Pose(0.25, 0.25, 0.0), replace(PARAMETERS, robot_radius=0.1))
    assert (len(search.frontiers), len(search.unreachable)) == (0, 1)


def test_long_frontiers_are_split() -> None:
    data = np.full((100, 100), UNKNOWN, np.int8)
    rows, columns = np.mgrid[:100, :100]
    data[np.hypot(rows - 50, columns - 50) < 40] = 0
    search = find_frontiers(OccupancyMap(data, CELL), Pose(5.05, 5.05, 0.0), PARAMETERS)
    assert len(search.frontiers) > 8
    for one in search.frontiers:
        assert np.hypot(*(one.points - one.points.mean(axis=0)).T).max() <= EXTENT / 2
        assert hypot(one.goal.x - 5.05, one.goal.y - 5.05) > 3.0


def test_a_costmap_is_read_as_move_base_publishes_it() -> None:
    """Inscribed cells (99) are neither a way nor a frontier, costs below are; unknown is -1."""
    data = np.full((20, 30), 0, np.int8)
    data[:, 25:] = UNKNOWN
    data[:10, 10] = 100
    data[:10, [8, 9, 11, 12]] = 99
    data[10:, 5:20] = 60
    data[:4, 20:25] = 99
    (found,) = find_frontiers(OccupancyMap(data, CELL), Pose(0.3, 0.3, 0.0), FrontierParameters()).frontiers
    assert len(found.points) == 16
    assert found.way > 2.4


def test_ranking_weighs_size_against_way() -> None:
    """As in explore_lite: (potential_scale * way - gain_scale * cells) * cell size."""
    known = picture("#" * 40, *["??" + "." * 37 + "#"] * 3, *["#" + "." * 37 + "??"] * 5, "#" * 40)
    robot = Pose(0.8, 0.45, 0.0)
    sizes = replace(PARAMETERS, robot_radius=0.05, potential_scale=1e-3)
    ways = replace(sizes, potential_scale=3.0)
    for parameters, x in ((sizes, 3.75), (ways, 0.25)):
        best = find_frontiers(known, robot, parameters).frontiers[0]
        assert best.middle[0] == pytest.approx(x)
        expected = (parameters.potential_scale * best.way - len(best.points)) * CELL
        assert best.cost == pytest.approx(expected)


def test_a_search_says_why_it_is_impossible() -> None:
    known = picture("####", "#..#", "#..#", "####")
    assert "off the map" in find_frontiers(known, Pose(9.0, 0.2, 0.0), PARAMETERS).reason
    walled = picture(*["#" * 30] * 30)
    assert "has room" in find_frontiers(walled, Pose(1.5, 1.5, 0.0), PARAMETERS).reason


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-3, 3), st.floats(-pi, pi))
def test_frontiers_move_with_the_maps_origin(seed: int, x: float, y: float, yaw: float) -> None:
    """The same map elsewhere in the world gives the same frontiers there; goals are free and in sight."""
    truth = floor_of(seed)
    start = roomy_start(truth)
    known = seen_from(truth, OccupancyMap(np.full_like(truth.data, UNKNOWN), CELL), start, 1.5)
    here = find_frontiers(known, start, PARAMETERS)
    at = Pose(x, y, yaw)
    there = find_frontiers(replace(known, origin=at), at.compose(start), PARAMETERS)
    assert len(here.frontiers) == len(there.frontiers)
    moved = sorted((round(one.cost, 6), round(one.way, 6)) for one in there.frontiers)
    assert moved == sorted((round(one.cost, 6), round(one.way, 6)) for one in here.frontiers)
    for one in here.frontiers:
        assert here.way_to(one.goal.x, one.goal.y) == pytest.approx(one.way)
        assert hypot(one.goal.x - one.middle[0], one.goal.y - one.middle[1]) <= REACH + CELL
        cells = known.world_to_cell(one.points)
        assert known.free[tuple(cells.T)].all()


# Choice


def search_of(known: OccupancyMap, x: float = 0.8) -> FrontierSearch:
    return find_frontiers(known, Pose(x, 0.45, 0.0), replace(PARAMETERS, robot_radius=0.05))


HALL = picture("#" * 40, *["??" + "." * 37 + "#"] * 3, *["#" + "." * 37 + "??"] * 5, "#" * 40)
ONE_END = picture("#" * 40, *["#" + "." * 38 + "#"] * 3, *["#" + "." * 37 + "??"] * 5, "#" * 40)
CLOSED = picture("#" * 40, *["#" + "." * 38 + "#"] * 8, "#" * 40)


def test_a_goal_is_kept_while_its_frontier_is_there() -> None:
    explorer = Explorer(PARAMETERS)
    assert explorer.update(search_of(HALL), 0.0, 0.0) is Action.DRIVE
    assert explorer.target is not None
    assert explorer.target.middle[0] == pytest.approx(0.25)
    assert explorer.update(search_of(HALL, 2.0), 1.0, 1.0) is Action.KEEP
    assert explorer.update(search_of(ONE_END), 2.0, 2.0) is Action.DRIVE
    assert explorer.target.middle[0] == pytest.approx(3.75)
    assert explorer.goals == 2


def test_the_end_comes_at_once_when_all_is_known() -> None:
    """The robot need not arrive at a goal whose frontier is gone."""
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(HALL), 0.0, 0.0)
    assert explorer.update(search_of(CLOSED), 1.0, 1.5) is Action.DONE
    assert explorer.target is None


def test_a_goal_without_progress_is_given_up() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(ONE_END), 0.0, 0.0)
    for now in (1.0, 15.0, 31.0):
        assert explorer.update(search_of(ONE_END), now, now) is Action.KEEP
    assert explorer.update(search_of(ONE_END), 32.0, 32.0) is Action.KEEP  # a newer map is awaited
    assert explorer.target is None
    assert [reason for _, reason in explorer.over] == ["no progress for 30 s"]
    assert explorer.update(search_of(ONE_END), 33.0, 33.0) is Action.DONE


def test_time_that_jumps_back_does_not_hold_up_exploration() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(ONE_END), 1000.0, 1000.0)
    for now in (1.0, 15.0, 31.0):
        assert explorer.update(search_of(ONE_END), now, now) is Action.KEEP
    explorer.update(search_of(ONE_END), 32.0, 32.0)
    assert explorer.target is None
    assert explorer.update(search_of(ONE_END), 1.0, 1.0) is Action.DONE


def test_progress_is_what_counts_not_time() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(ONE_END), 0.0, 0.0)
    for step in range(1, 12):
        near = search_of(ONE_END, 0.8 + 0.2 * step)
        assert explorer.update(near, 20.0 * step, 20.0 * step) is Action.KEEP


def test_failed_goals_are_not_chosen_again() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(HALL), 0.0, 0.0)
    explorer.failed("aborted", 1.0)
    assert explorer.update(search_of(HALL), 1.5, 2.0) is Action.DRIVE
    assert explorer.target is not None
    assert explorer.target.middle[0] == pytest.approx(3.75)
    explorer.failed("aborted", 3.0)
    assert explorer.update(search_of(HALL), 4.0, 4.0) is Action.DONE
    assert [explorer.is_over(one) for one in search_of(HALL).frontiers] == [True, True]


def test_the_end_waits_for_the_map_of_the_last_goal() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(ONE_END), 0.0, 0.0)
    explorer.reached(5.0)
    assert explorer.update(search_of(ONE_END), 4.0, 6.0) is Action.KEEP
    assert explorer.update(search_of(HALL), 7.0, 7.0) is Action.DRIVE  # the newer map shows another frontier
    explorer.reached(8.0)
    assert explorer.update(search_of(HALL), 7.0, 8.0 + MAP_WAIT) is Action.DONE


def test_a_goal_that_became_an_obstacle_is_moved() -> None:
    explorer = Explorer(PARAMETERS)
    explorer.update(search_of(ONE_END), 0.0, 0.0)
    assert explorer.target is not None
    old = explorer.target.goal
    data = ONE_END.data.copy()
    data[tuple(ONE_END.world_to_cell((old.x, old.y)))] = 100
    assert explorer.update(search_of(OccupancyMap(data, CELL)), 1.0, 1.0) is Action.DRIVE
    assert explorer.target.goal != old


def test_a_lost_robot_ends_nothing() -> None:
    """A robot that is off the map for a moment keeps its goal; without one the exploration is not over."""
    explorer = Explorer(PARAMETERS)
    off = search_of(HALL, 90.0)
    assert explorer.update(off, 0.0, 0.0) is Action.KEEP
    explorer.update(search_of(HALL), 1.0, 1.0)
    assert explorer.update(off, 2.0, 2.0) is Action.KEEP
    assert explorer.target is not None
    explorer.forget()
    assert explorer.over == []
    assert explorer.update(search_of(CLOSED), 3.0, 3.0) is Action.DONE


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from((1.0, 2.0, inf)))
def test_every_floor_is_explored_to_the_end(seed: int, reach: float) -> None:
    """Whatever the floor and the sensor's reach: it ends, and what the robot can reach is known."""
    truth = floor_of(seed)
    start = roomy_start(truth)
    known, explorer = explore(truth, start, min(reach, 8.0))
    search = find_frontiers(truth, start, PARAMETERS)
    centres = truth.cell_to_world(np.argwhere(truth.free))
    reachable = np.array([search.way_to(x, y) < inf for x, y in centres])
    seen = known.values_at(centres[reachable]) != UNKNOWN
    assert seen.mean() > 0.97
    assert explorer.goals <= reachable.sum()
    wrong = (known.data != UNKNOWN) & (known.data != truth.data)
    assert not wrong.any()
