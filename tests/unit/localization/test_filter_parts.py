"""The parts of the particle filter: motion, likelihoods, resampling, clusters."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose
from rce_fleet.localization import clusters, likelihood, motion, resampling
from rce_fleet.localization.beam_model import BeamModel
from rce_fleet.localization.clusters import find_hypotheses
from rce_fleet.localization.likelihood import LikelihoodField
from rce_fleet.localization.motion import move_particles
from rce_fleet.localization.parameters import AmclParameters, OdometryModel
from rce_fleet.localization.resampling import (
    HEADINGS,
    bin_numbers,
    effective_count,
    particles_needed,
    resample,
    split_bins,
    systematic,
    temper,
)
from rce_fleet.localization.scan import Beams, LaserScan, select_beams
from rce_fleet.maps.distance import Squares
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def cloud(count: int = 20_000, pose: Sequence[float] = (1.0, 2.0, 0.5)) -> np.ndarray[tuple[int, int]]:
    return np.repeat(np.array(pose)[:, None], count, axis=1)


# Motion


@pytest.mark.parametrize("model", list(OdometryModel))
def test_without_alphas_particles_move_as_odometry(model: OdometryModel) -> None:
    exact = AmclParameters(
        odom_model_type=model, odom_alpha1=0, odom_alpha2=0, odom_alpha3=0, odom_alpha4=0, odom_alpha5=0
    )
    before, after = Pose(3.0, 1.0, 2.0), Pose(2.6, 1.3, 2.4)
    moved = move_particles(cloud(3), before, after, exact, rng())
    expected = Pose(1.0, 2.0, 0.5).compose(after.relative_to(before))
    assert moved[:2, 0] == pytest.approx((expected.x, expected.y))
    assert np.cos(moved[2, 0] - expected.yaw) == pytest.approx(1.0)


def test_errors_have_the_spread_of_the_alphas() -> None:
    before, after = Pose(0.0, 0.0, 0.0), Pose(0.5, 0.0, 0.0)
    for model, sigma in ((OdometryModel.DIFF, 0.3 * 0.25), (OdometryModel.DIFF_CORRECTED, np.sqrt(0.075))):
        chosen = AmclParameters(odom_model_type=model, odom_alpha1=0, odom_alpha2=0, odom_alpha3=0.3)
        moved = move_particles(cloud(pose=(0.0, 0.0, 0.0)), before, after, chosen, rng())
        assert moved[0].std() == pytest.approx(sigma, rel=0.05)
        assert moved[0].mean() == pytest.approx(0.5, abs=0.01)
        assert not moved[1:].any()


def test_driving_backwards_errs_as_forwards() -> None:
    spreads = []
    for x in (0.5, -0.5):
        moved = move_particles(cloud(), Pose(0.0, 0.0, 0.0), Pose(x, 0.0, 0.0), AmclParameters(), rng())
        spreads.append(moved[2].std())
    assert spreads[0] == pytest.approx(spreads[1])


def test_an_omni_robot_errs_across_its_way() -> None:
    chosen = AmclParameters(odom_model_type=OdometryModel.OMNI, odom_alpha1=0, odom_alpha3=0, odom_alpha5=0.4)
    moved = move_particles(
        cloud(pose=(0.0, 0.0, 0.0)), Pose(0.0, 0.0, 0.0), Pose(0.0, 0.5, 0.0), chosen, rng()
    )
    assert moved[1].std() < 1e-9
    assert moved[0].std() == pytest.approx(0.4 * 0.25, rel=0.05)


# Beams and likelihoods


def room() -> OccupancyMap:
    data = np.zeros((60, 80), np.int8)
    data[0] = data[-1] = data[:, 0] = data[:, -1] = data[20:30, 40:50] = 100
    return OccupancyMap(data, 0.05, Pose(-1.0, 0.5, 0.3))


def beams_at(pose: Pose, count: int = 40) -> Beams:
    angles = np.linspace(-pi, pi, count, endpoint=False)
    return Beams(
        cast_rays(room(), (pose.x, pose.y), angles + pose.yaw, 6.0), angles, 6.0, Pose(0.0, 0.0, 0.0)
    )


def test_beams_are_evenly_chosen_and_checked() -> None:
    ranges = np.array([1.0, 0.01, np.nan, 9.0, np.inf, 2.0, -1.0, 3.0, 4.0])
    scan = LaserScan(ranges, -1.0, 0.25, 0.1, 5.0, Pose(0.1, 0.0, 0.5))
    beams = select_beams(scan, AmclParameters(laser_max_beams=9))
    assert beams.ranges.tolist() == [1.0, 5.0, 5.0, 5.0, 2.0, 5.0, 3.0, 4.0]
    assert beams.returned.tolist() == [True, False, False, False, True, False, True, True]
    assert beams.angles[[0, 1, 2]].tolist() == [-0.5, -0.25, 0.25]
    assert len(select_beams(scan, AmclParameters(laser_max_beams=3)).ranges) == 3
    near = select_beams(scan, AmclParameters(laser_max_beams=9, laser_max_range=2.5, laser_min_range=1.5))
    assert near.ranges[near.returned].tolist() == [2.0]


def test_a_laser_off_the_centre() -> None:
    ends = Beams(np.array([1.0]), np.array([pi / 2]), 6.0, Pose(0.2, 0.1, pi / 2)).ends
    assert ends[:, 0] == pytest.approx((0.2, 1.1))


def test_the_field_prefers_the_true_pose() -> None:
    truth = Pose(0.3, 1.7, 0.8)
    field = LikelihoodField(room(), AmclParameters())
    offsets = np.array([[0, 0, 0], [0.2, 0, 0], [0, -0.2, 0], [0, 0, 0.3], [0.6, 0.5, 1.0]]).T
    particles = truth.as_array()[:, None] + offsets
    for weights in (
        field.sums_of_cubes(particles, beams_at(truth)),
        field.log_products(particles, beams_at(truth)),
        BeamModel(room(), AmclParameters()).sums_of_cubes(particles, beams_at(truth)),
    ):
        assert weights.argmax() == 0


def test_the_beam_model_expects_the_ranges_of_the_map() -> None:
    truth = Pose(0.3, 1.7, 0.8)
    expected = BeamModel(room(), AmclParameters()).expected(truth.as_array()[:, None], beams_at(truth))
    assert expected[0] == pytest.approx(beams_at(truth).ranges)


def test_skipped_beams_do_not_count() -> None:
    truth = Pose(0.3, 1.7, 0.8)
    seen = beams_at(truth)
    blocked = seen.ranges.copy()
    blocked[:8] = 0.2  # a box that is on no map
    beams = Beams(blocked, seen.angles, 6.0, seen.laser)
    field = LikelihoodField(room(), AmclParameters(do_beamskip=True))
    particles = truth.as_array()[:, None] + 0.02 * rng().standard_normal((3, 50))
    all_of_them = field.log_products(particles, beams)
    skipped = field.log_products(particles, beams, skip=True)
    assert (skipped > all_of_them + 8).all()
    field = LikelihoodField(room(), AmclParameters(beam_skip_error_threshold=0.1))
    assert field.log_products(particles, beams, skip=True) == pytest.approx(all_of_them)


@pytest.mark.parametrize(("beams", "share"), [(4, 1.0), (61, 0.5), (601, 0.05)])
def test_near_beams_count_less(beams: int, share: float) -> None:
    """They end on a wall of 3 m, 5 cm or 5 mm apart."""
    ends = np.stack((np.full(beams, 2.0), np.linspace(-1.5, 1.5, beams)))
    seen = Beams(np.hypot(*ends), np.arctan2(ends[1], ends[0]), 10.0, Pose(0.0, 0.0, 0.0))
    assert seen.independence == pytest.approx(share, rel=1e-6)


@pytest.mark.slow
def test_compiled_likelihoods_equal_those_of_numpy() -> None:
    pytest.importorskip("numba")
    draw = rng(3)
    table, ends = draw.random(50), draw.uniform(-2, 2, (2, 33))
    particles, frame = draw.uniform(-1, 4, (3, 200)), np.array((0.3, -0.5, 0.7))
    loop, plain = likelihood.sum_at_ends.compile(), likelihood.sum_at_ends.numpy
    for kind in (np.uint16, np.uint32):
        squares: Squares = draw.integers(0, 50, (30, 40)).astype(kind)
        expected = plain(table, squares, particles, ends, frame, 0.1)
        assert loop(table, squares, particles, ends, frame, 0.1) == pytest.approx(expected, rel=1e-12)


def test_compiled_motion_equals_that_of_numpy() -> None:
    pytest.importorskip("numba")
    given = rng(1).normal(size=(3, 50)), rng(2).normal(size=(3, 50)), np.array((0.1, 0.2, 0.3)), np.ones(3)
    assert motion.turn_drive_turn.compile()(*given) == pytest.approx(motion.turn_drive_turn.numpy(*given))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_compiled_resampling_equals_that_of_numpy(seed: int) -> None:
    pytest.importorskip("numba")
    draw = rng(seed)
    particles = draw.uniform((-3, -3, -7), (3, 3, 7), (300, 3)).T.copy()
    bins = resampling._bins_loop.numpy(particles)
    assert (resampling._bins_loop.compile()(particles) == bins).all()
    for some in (bins, bins[:5], bins % 7):
        expected = resampling.distinct.numpy(some)
        found = resampling.distinct.compile()(some)
        assert (found[0] == expected[0]).all()
        assert (found[1] == expected[1]).all()
    _, members = resampling.distinct.numpy(bins)
    sums = np.cumsum(draw.random(300))
    needed = resampling._needed_table(AmclParameters(min_particles=20, max_particles=900, kld_err=0.3))
    for draws in (draw.random(10), draw.random(400), draw.random(900)):
        stop = resampling.stop_of_draws.numpy(members, sums, draws, needed)
        assert resampling.stop_of_draws.compile()(members, sums, draws, needed) == stop
    chosen = resampling._systematic_loop.numpy(sums, 77, 0.4)
    assert (resampling._systematic_loop.compile()(sums, 77, 0.4) == chosen).all()


@pytest.mark.parametrize("seed", range(5))
def test_compiled_clusters_equal_those_of_numpy(seed: int) -> None:
    pytest.importorskip("numba")
    draw = rng(seed)
    particles, weights = draw.uniform(-4, 4, (3, 80)), draw.random(80)
    expected = clusters.moments.numpy(particles, weights)
    assert clusters.moments.compile()(particles, weights) == pytest.approx(expected)
    bins = split_bins(np.unique(bin_numbers(particles)))
    assert clusters.label_few.compile()(bins).tolist() == clusters.label_few.numpy(bins).tolist()


# Resampling


@given(st.lists(st.tuples(*[st.floats(-3000, 3000)] * 2, st.floats(-10, 10)), min_size=1, max_size=20))
def test_bins_survive_their_numbers(poses: list[tuple[float, float, float]]) -> None:
    particles = np.array(poses).T
    columns, rows, headings = split_bins(bin_numbers(particles))
    assert columns.tolist() == np.floor(particles[0] / 0.5).tolist()
    assert rows.tolist() == np.floor(particles[1] / 0.5).tolist()
    assert ((headings >= 0) & (headings < HEADINGS)).all()


def test_more_bins_need_more_particles() -> None:
    chosen = AmclParameters(min_particles=10, max_particles=4000)
    needed = particles_needed(np.arange(1, 200), chosen)
    assert needed[0] == 10
    assert (np.diff(needed) >= 0).all()
    assert needed[-1] == 4000
    # Fox's formula for k = 10, epsilon 0.01, z 0.99
    assert needed[9] == np.ceil(9 / 0.02 * (1 - 2 / 81 + np.sqrt(2 / 81) * 0.99) ** 3)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=400), st.integers(1, 60))
def test_kld_sampling_stops_as_one_by_one(drawn: list[int], least: int) -> None:
    chosen = AmclParameters(min_particles=least, max_particles=5000, kld_err=0.5)
    seen: set[int] = set()
    expected = None
    for count, each in enumerate(drawn, 1):
        seen.add(each)
        if count >= particles_needed(len(seen), chosen):
            expected = count
            break
    bins = np.array(drawn)
    even = (np.arange(len(bins)) + 1.0) / len(bins)
    draws = (np.arange(len(bins)) + 0.5) / len(bins)  # each particle once, in this order
    needed = resampling._needed_table(chosen)
    assert resampling.stop_of_draws(bins, even, draws, needed) == (expected or -1)


def test_systematic_sampling_keeps_proportions() -> None:
    weights = np.array([0.1, 0.0, 0.6, 0.3])
    assert np.bincount(systematic(weights, 1000, rng()), minlength=4).tolist() == [100, 0, 600, 300]


def test_resampling_takes_as_many_as_are_needed() -> None:
    chosen = AmclParameters(min_particles=50, max_particles=3000)
    draw = rng(1)
    near = cloud(500, (1.2, 2.2, 0.45)) + 0.01 * draw.standard_normal((3, 500))
    far = draw.uniform(-20, 20, (3, 3000))
    even = np.full(500, 1 / 500), np.full(3000, 1 / 3000)
    assert len(resample(near, even[0], chosen, draw)) < 500
    assert len(resample(far, even[1], chosen, draw)) == 3000


def test_tempered_weights_keep_enough_particles() -> None:
    even = np.full(1000, 0.001)
    logs = -(np.arange(1000.0) ** 2)
    assert effective_count(temper(even, logs, 0.0)) < 2
    made = temper(even, logs, 0.3)
    assert 300 <= effective_count(made) < 330
    assert (np.diff(made) <= 0).all()
    assert made.sum() == pytest.approx(1.0)
    flat = temper(even, -1e-3 * np.arange(1000.0), 0.3)
    assert flat == pytest.approx(np.exp(-1e-3 * np.arange(1000)) / np.exp(-1e-3 * np.arange(1000)).sum())


def test_particles_without_weight_stay_without_it() -> None:
    weights = np.array([0.0, 0.5, 0.5, 0.0])
    for logs in ([0.0, -1000.0, -1001.0, -1.0], [2000.0, -3.0, -4.0, np.inf]):
        made = temper(weights, np.array(logs), 0.0)
        assert made == pytest.approx([0.0, 1 / (1 + np.exp(-1)), np.exp(-1) / (1 + np.exp(-1)), 0.0])


# Clusters


def test_the_heaviest_cluster_comes_first() -> None:
    draw = rng(2)
    small, large = draw.normal((1, 1, 0), 0.05, (300, 3)), draw.normal((6, 2, 1), 0.05, (100, 3))
    particles = np.concatenate((small, large)).T
    weights = np.concatenate((np.full(300, 0.001), np.full(100, 0.007)))
    found = find_hypotheses(particles, weights)
    assert [each.weight for each in found] == pytest.approx([0.7, 0.3])
    assert (found[0].pose.x, found[0].pose.y) == pytest.approx((6, 2), abs=0.05)
    assert np.sqrt(np.diag(found[0].covariance)) == pytest.approx([0.05] * 3, rel=0.3)


def test_a_cluster_crosses_the_back() -> None:
    particles = np.stack((np.ones(100), np.ones(100), pi + np.linspace(-0.3, 0.3, 100)))
    (found,) = find_hypotheses(particles, np.full(100, 0.01))
    assert abs(found.pose.yaw) == pytest.approx(pi, abs=0.01)
    assert found.covariance[2, 2] == pytest.approx(0.03, rel=0.1)


def test_many_bins_are_clustered_as_few(monkeypatch: pytest.MonkeyPatch) -> None:
    particles = rng(4).uniform((0, 0, -pi), (9, 9, pi), (400, 3)).T
    weights = np.full(400, 1 / 400)
    assert len(np.unique(bin_numbers(particles))) > 200
    by_graph = find_hypotheses(particles, weights, most=500)
    monkeypatch.setattr("rce_fleet.localization.clusters._FEW", 10_000)
    by_pairs = find_hypotheses(particles, weights, most=500)
    assert [each.weight for each in by_graph] == pytest.approx([each.weight for each in by_pairs])
    assert len(by_graph) > 10
