"""Which cells of the fleet's grid are reported blocked, and free again."""

from __future__ import annotations

import os
from math import inf, pi
from pathlib import Path

import numpy as np
import pytest
from support.flat_world import edges_of

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.observation import Observation, observe_scan
from rce_fleet.navigation.costmap.parameters import ObservationSource
from rce_fleet.navigation.obstacle_cells.passage import can_pass
from rce_fleet.navigation.obstacle_cells.watch import CellWatch, Findings, WatchParameters
from rce_fleet.simulation.lidar import LidarSpec, cast

LIDAR = LidarSpec(360, 6.0)
SOURCE = ObservationSource(clearing=True, inf_is_valid=True, obstacle_range=4.0, raytrace_range=4.0)
BOX = (2.2, 1.2, 2.8, 1.8)
"""0.6 m in the middle of cell 6 of a grid with 4 columns of 1 m."""


ORIGIN = Pose(0.0, 0.0, 0.0)


def fleet(origin: Pose = ORIGIN) -> OccupancyMap:
    return OccupancyMap(np.zeros((4, 4), np.int8), 1.0, origin)


def look(at: Pose, *boxes: tuple[float, float, float, float], discs: np.ndarray | None = None) -> Observation:
    circles = np.empty((0, 3)) if discs is None else discs
    ranges = cast(LIDAR, (at.x, at.y), at.yaw, edges_of(list(boxes)), circles)
    ranges = np.where(ranges < 6.0, ranges, inf)
    return observe_scan(ranges, -pi, LIDAR.increment, (0.05, 6.0), at, SOURCE, 0.0)


def watch_for(watch: CellWatch, seen: Observation, begin: float, **others: object) -> Findings:
    """Let a watch see the same for a second and a half."""
    findings = Findings()
    for step in range(15):
        findings = watch.take(seen, begin + step * 0.1, **others)  # type: ignore[arg-type] # by name
    return findings


HERE = Pose(0.5, 1.5, 0.0)


def resident() -> int:
    """Return how much memory this process has, bytes."""
    return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_box_that_fills_a_cell_is_reported_and_freed() -> None:
    watch = CellWatch(fleet(), WatchParameters())
    assert watch_for(watch, look(HERE, BOX), 1.0) == Findings((6,), ())
    assert watch_for(watch, look(HERE, BOX), 3.0, suspects=(6,)).freed == ()
    assert watch_for(watch, look(HERE), 5.0, suspects=(6,)) == Findings((), (6,))


def test_time_that_jumps_back_begins_a_watch_anew() -> None:
    """A cell is found blocked, and free, within a second, not when the time before comes again."""
    watch = CellWatch(fleet(), WatchParameters())
    watch_for(watch, look(HERE, BOX), 1000.0)
    assert watch_for(watch, look(HERE, BOX), 1.0) == Findings((6,), ())
    assert watch_for(watch, look(HERE, BOX), 3.0, suspects=(6,)).freed == ()
    assert watch_for(watch, look(HERE), 5.0, suspects=(6,)) == Findings((), (6,))


def test_a_watch_of_a_large_floor_takes_little_memory() -> None:
    """Only what is near the robot: a floor of half a kilometre has 400 million parts."""
    floor = OccupancyMap(np.zeros((1000, 1000), np.int8), 0.5)
    before = resident()
    watch = CellWatch(floor, WatchParameters())
    for place in (10.0, 250.0, 490.0):
        seen = look(Pose(place, place, 0.0), (place + 1.7, place - 0.3, place + 2.3, place + 0.3))
        assert watch_for(watch, seen, 1.0).blocked
    assert resident() - before < 100e6


def test_a_cell_that_no_one_suspects_is_not_freed() -> None:
    watch = CellWatch(fleet(), WatchParameters())
    assert watch_for(watch, look(HERE), 1.0) == Findings()


def test_a_short_sight_is_not_reported() -> None:
    """Something that is there for less than half a second, such as a person who walks by."""
    watch = CellWatch(fleet(), WatchParameters())
    for step in range(4):
        assert watch.take(look(HERE, BOX), 1.0 + step * 0.1) == Findings()


@pytest.mark.parametrize(
    "box", [(2.05, 1.05, 2.2, 1.2), (2.75, 1.1, 2.95, 1.4)], ids=["in a corner", "at a side"]
)
def test_a_box_that_leaves_a_passage_is_not_reported(box: tuple[float, float, float, float]) -> None:
    watch = CellWatch(fleet(), WatchParameters(robot_radius=0.2, border=0.0))
    assert watch_for(watch, look(HERE, box), 1.0) == Findings()


def test_another_robot_is_not_reported() -> None:
    robot = np.array(((2.5, 1.5, 0.35),))
    seen = look(HERE, discs=robot)
    assert watch_for(CellWatch(fleet(), WatchParameters()), seen, 1.0).blocked == (6,)
    assert watch_for(CellWatch(fleet(), WatchParameters()), seen, 1.0, robots=robot).blocked == ()
    assert watch_for(CellWatch(fleet(), WatchParameters()), seen, 1.0, held=(6,)).blocked == ()


def test_a_robot_that_left_its_cell_unseen_is_not_reported() -> None:
    """A box hides the cell when the other robot drives on; what was seen there was that robot."""
    robot = np.array(((2.5, 1.5, 0.35),))
    in_between = (1.2, 1.1, 1.4, 1.9)
    watch = CellWatch(fleet(), WatchParameters())
    watch_for(watch, look(HERE, discs=robot), 1.0, held=(6,))
    assert 6 not in watch_for(watch, look(HERE, in_between), 3.0).blocked


def test_what_is_on_the_map_is_not_reported() -> None:
    picture = np.zeros((80, 80), np.int8)
    picture[24:36, 44:56] = 100
    known = OccupancyMap(picture, 0.05)
    watch = CellWatch(fleet(), WatchParameters(), known)
    assert watch_for(watch, look(HERE, BOX), 1.0) == Findings()


def test_a_rotated_grid_names_its_own_cells() -> None:
    """Turned by 90 degrees about (4, 0), columns grow along y and rows along -x."""
    watch = CellWatch(fleet(Pose(4.0, 0.0, pi / 2)), WatchParameters())
    assert watch_for(watch, look(HERE, BOX), 1.0).blocked == (1 * 4 + 1,)


def test_what_is_out_of_sight_stays_as_it_was() -> None:
    watch = CellWatch(fleet(), WatchParameters())
    watch_for(watch, look(HERE, BOX), 1.0)
    away = look(Pose(0.5, 3.9, 0.0))
    assert watch_for(watch, away, 3.0, suspects=(6,)) == Findings()


@pytest.mark.parametrize(
    ("left", "low", "right", "high", "passes"),
    [
        (0, 0, 0, 0, True),
        (4, 4, 16, 16, False),  # a box in the middle leaves 20 cm on each side
        (8, 8, 12, 12, False),  # a post in the middle
        (0, 0, 5, 5, True),
        (9, 0, 11, 20, False),  # a wall across: no robot can stand in the middle
        (0, 0, 20, 5, True),
        (0, 0, 20, 8, False),
    ],
)
def test_a_passage_needs_room_for_the_disc(left: int, low: int, right: int, high: int, passes: bool) -> None:
    blocked = np.zeros((20, 20), np.bool_)
    blocked[low:high, left:right] = True
    assert can_pass(blocked, 1.0, 0.22) is passes
