"""The particle filter on a small floor without symmetry."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest
from numpy.typing import NDArray

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl, Estimate
from rce_fleet.localization.contradiction import contradicts_map, explained_shares
from rce_fleet.localization.parameters import AmclParameters, LaserModel, OdometryModel
from rce_fleet.localization.replay import Recorded, replay
from rce_fleet.localization.scan import LaserScan, select_beams
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays

BEAMS = 90
START = Pose(1.0, 1.0, 0.3)
SMALL = AmclParameters(
    max_particles=1500, laser_max_beams=BEAMS, laser_model_type=LaserModel.LIKELIHOOD_FIELD_PROB
)


def floor(origin: Pose | None = None) -> OccupancyMap:
    data = np.zeros((80, 100), np.int8)
    data[0] = data[-1] = data[:, 0] = data[:, -1] = 100
    data[30:40, 0:35] = data[55:80, 60:66] = data[15:22, 70:85] = 100
    return OccupancyMap(data, 0.05, origin or Pose(0.0, 0.0, 0.0))


GRID = floor()


def scan(pose: Pose, grid: OccupancyMap = GRID) -> LaserScan:
    angles = -pi + np.arange(BEAMS) * (2 * pi / BEAMS)
    ranges = cast_rays(grid, (pose.x, pose.y), angles + pose.yaw, 8.0)
    return LaserScan(ranges, -pi, 2 * pi / BEAMS, 0.1, 8.0)


def way(count: int, start: Pose = START, turn: float = 0.13) -> list[Pose]:
    """Poses 0.22 m apart on an arc."""
    poses = [start]
    for _ in range(count - 1):
        poses.append(poses[-1].compose(Pose(0.22, 0.0, turn)))
    return poses


def drive(
    amcl: Amcl, poses: list[Pose], grid: OccupancyMap = GRID, *, later: OccupancyMap | None = None
) -> Estimate:
    """Drive with odometry that is 3 % too long and 2 % too straight; return the last estimate.

    From the fourth pose on, the map is ``later``.
    """
    odometry, estimate = Pose(5.0, -3.0, 1.0), None
    for index, pose in enumerate(poses):
        if later is not None and index == 4:
            grid = later
            amcl.set_map(grid)
        if index:
            step = pose.relative_to(poses[index - 1])
            odometry = odometry.compose(Pose(1.03 * step.x, step.y, 0.98 * step.yaw))
        estimate = amcl.update(odometry, scan(pose, grid)) or estimate
    assert estimate is not None
    return estimate


def error(estimate: Estimate, truth: Pose) -> tuple[float, float]:
    pose = estimate.pose
    return hypot(pose.x - truth.x, pose.y - truth.y), abs(wrap(pose.yaw - truth.yaw))


def filtered(parameters: AmclParameters = SMALL, grid: OccupancyMap = GRID, seed: int = 1) -> Amcl:
    amcl = Amcl(grid, parameters, np.random.default_rng(seed))
    amcl.set_pose(Pose(1.1, 0.9, 0.25), np.diag((0.04, 0.04, 0.02)))
    return amcl


@pytest.mark.slow
@pytest.mark.parametrize("odometry", list(OdometryModel))
@pytest.mark.parametrize("laser", [LaserModel.LIKELIHOOD_FIELD, LaserModel.LIKELIHOOD_FIELD_PROB])
def test_all_models_follow_the_robot(odometry: OdometryModel, laser: LaserModel) -> None:
    alpha = 0.01 if "corrected" in odometry else 0.2
    chosen = replace(
        SMALL,
        odom_model_type=odometry,
        laser_model_type=laser,
        odom_alpha1=alpha,
        odom_alpha2=alpha,
        odom_alpha3=alpha,
        odom_alpha4=alpha,
        odom_alpha5=alpha,
    )
    estimate = drive(filtered(chosen), poses := way(14))
    away, turned = error(estimate, poses[-1])
    assert away < 0.1
    assert turned < 0.05
    assert estimate.agreement > 0.85
    found = estimate.map_from_odom.compose(Pose(5.0, -3.0, 1.0))
    assert hypot(found.x - START.x, found.y - START.y) < 0.5


def test_the_beam_model_follows_the_robot() -> None:
    beam = replace(SMALL, laser_model_type=LaserModel.BEAM, laser_max_beams=20, max_particles=300)
    estimate = drive(filtered(beam), poses := way(6))
    assert error(estimate, poses[-1])[0] < 0.12


def test_a_turned_map_with_an_origin() -> None:
    origin = Pose(-4.0, 7.0, 2.0)
    grid = floor(origin)
    amcl = Amcl(grid, SMALL, np.random.default_rng(2))
    poses = [origin.compose(pose) for pose in way(12)]
    amcl.set_pose(poses[0], np.diag((0.04, 0.04, 0.02)))
    away, turned = error(drive(amcl, poses, grid), poses[-1])
    assert away < 0.1
    assert turned < 0.05


def test_fewer_particles_once_the_pose_is_known() -> None:
    amcl = filtered()
    assert len(amcl.weights) == SMALL.max_particles
    drive(amcl, way(14))
    assert len(amcl.weights) < SMALL.max_particles / 3
    assert amcl.weights.sum() == pytest.approx(1.0)
    assert amcl.particles.shape == (len(amcl.weights), 3)


@pytest.mark.slow
def test_the_covariance_covers_the_error() -> None:
    errors = []
    for seed in range(6):
        estimate = drive(filtered(seed=seed), poses := way(10))
        truth = poses[-1]
        off = np.array(
            (estimate.pose.x - truth.x, estimate.pose.y - truth.y, wrap(estimate.pose.yaw - truth.yaw))
        )
        errors.append(off @ np.linalg.solve(estimate.covariance, off))
    assert 0.05 < np.mean(errors) < 12


@pytest.mark.slow
def test_a_robot_without_a_known_pose_is_found() -> None:
    amcl = Amcl(GRID, replace(SMALL, max_particles=4000), np.random.default_rng(3))
    amcl.scatter()
    particles = amcl.particles
    assert (GRID.values_at(particles[:, :2]) == 0).all()
    assert np.ptp(particles[:, 0]) > 4
    estimate = drive(amcl, poses := way(18))
    assert error(estimate, poses[-1])[0] < 0.2


def test_the_first_scan_draws_particles_where_it_fits() -> None:
    amcl = Amcl(GRID, SMALL, np.random.default_rng(2))
    amcl.scatter()
    amcl.update(Pose(0.0, 0.0, 0.0), scan(START))
    x, y, yaw = amcl.particles.T
    near = (np.hypot(x - START.x, y - START.y) < 0.5) & (np.abs(yaw - START.yaw) < 0.3)
    by_chance = len(x) * (pi * 0.5**2 / (GRID.free.sum() * GRID.resolution**2)) * (0.6 / (2 * pi))
    assert near.sum() > 4 * by_chance
    assert len(x) <= SMALL.max_particles


@pytest.mark.slow
def test_a_robot_that_was_moved_by_hand_is_found() -> None:
    amcl = filtered(replace(SMALL, max_particles=4000, recovery_alpha_slow=0.001, recovery_alpha_fast=0.1))
    drive(amcl, way(6))
    moved = way(40, Pose(3.1, 1.2, pi / 2), 0.367)
    amcl.request_update()
    estimate = drive(amcl, moved)
    assert error(estimate, moved[-1])[0] < 0.25


def test_robots_around_one_do_not_look_like_elsewhere() -> None:
    """Half of the beams end at things on no map: the robot stays where it is, and draws nothing elsewhere."""
    amcl = filtered(replace(SMALL, recovery_alpha_slow=0.001, recovery_alpha_fast=0.1))
    seen, stand = scan(START), Pose(0.0, 0.0, 0.0)
    around = np.arange(BEAMS) % 10 < 5
    among = replace(seen, ranges=np.where(around, 0.6 * seen.ranges, seen.ranges))
    for each in [seen] * 20 + [among] * 10:
        amcl.update(stand, each)
        amcl.request_update()
    assert np.ptp(amcl.particles[:, 0]) < 1
    assert np.ptp(amcl.particles[:, 1]) < 1


@pytest.mark.parametrize(
    ("pose", "factor", "contradicted"),
    [
        (START, 1.0, False),
        (START, 0.5, True),  # everything is nearer: nothing of the map is seen
        (START, 1.3, True),  # walls are seen through
        (Pose(3.0, 2.5, 1.0), 1.0, True),
    ],
)
def test_scan_contradicts_the_map(pose: Pose, factor: float, contradicted: bool) -> None:
    seen = scan(START)
    scaled = replace(seen, ranges=np.minimum(factor * seen.ranges, seen.range_max))
    assert contradicts_map(GRID, pose, select_beams(scaled, SMALL)) is contradicted


def test_scan_without_returns_contradicts_nothing() -> None:
    empty = replace(scan(START), ranges=np.full(BEAMS, np.inf))
    assert explained_shares(GRID, START, select_beams(empty, SMALL)) == (0.0, 1.0)


def test_recovery_is_off_by_default() -> None:
    amcl = filtered()
    drive(amcl, way(6))
    assert np.ptp(amcl.particles[:, 0]) < 1


def test_a_standing_robot_is_not_updated() -> None:
    amcl = filtered()
    odometry = Pose(0.0, 0.0, 0.0)
    assert amcl.update(odometry, scan(START)) is not None
    assert amcl.update(Pose(0.1, 0.0, 0.0), scan(START)) is None
    amcl.request_update()
    assert amcl.update(odometry, scan(START)) is not None
    assert amcl.update(Pose(0.0, 0.0, 0.6), scan(START)) is not None


def test_the_same_seed_gives_the_same_poses() -> None:
    first, second = (drive(filtered(seed=5), way(5)) for _ in range(2))
    assert first.pose == second.pose
    assert drive(filtered(seed=6), way(5)).pose != first.pose


def test_a_map_that_changed_under_way() -> None:
    amcl = filtered()
    data = GRID.data.copy()
    data[60:70, 20:30] = 100
    changed = OccupancyMap(data, 0.05)
    assert error(drive(amcl, poses := way(8), later=changed), poses[-1])[0] < 0.15
    with pytest.raises(MapError, match="no free cell"):
        amcl.set_map(OccupancyMap(np.full((3, 3), -1, np.int8)))
    assert amcl.grid is changed


def faulty(values: NDArray[np.float64]) -> LaserScan:
    return LaserScan(values, -pi, 2 * pi / BEAMS, 0.1, 8.0)


@pytest.mark.parametrize(
    "values",
    [
        np.empty(0),
        np.full(BEAMS, np.nan),
        np.full(BEAMS, np.inf),
        np.full(BEAMS, -np.inf),
        np.full(BEAMS, 8.0),
        np.full(7, 0.5),
    ],
)
@pytest.mark.parametrize("laser", list(LaserModel))
def test_useless_scans_leave_finite_poses(values: NDArray[np.float64], laser: LaserModel) -> None:
    amcl = filtered(replace(SMALL, laser_model_type=laser, laser_max_beams=10, max_particles=200))
    for number in range(3):
        estimate = amcl.update(Pose(0.3 * number, 0.0, 0.0), faulty(values))
        assert estimate is not None
        assert np.isfinite(estimate.covariance).all()
        assert np.isfinite(amcl.particles).all()


def test_a_replayed_log_gives_a_pose_for_each_scan() -> None:
    poses = way(10)
    log = [Recorded(pose.relative_to(poses[0]), scan(pose)) for pose in poses for _ in range(2)]
    found = list(replay(log, GRID, SMALL, seed=1, start=START))
    assert len(found) == len(log)
    assert sum(each.estimate is None for each in found) == 10
    last = found[-1].pose
    assert hypot(last.x - poses[-1].x, last.y - poses[-1].y) < 0.1
    anywhere = list(replay(log, GRID, SMALL, seed=1))
    assert anywhere[0].pose != found[0].pose
