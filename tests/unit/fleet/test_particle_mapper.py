"""The Rao-Blackwellized particle filter and its mapper."""

from __future__ import annotations

from dataclasses import replace
from math import log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.lidar_drive import BEAMS, drive

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.gmapping.filter import GridFilter
from rce_fleet.mapping.gmapping.mapper import ParticleMapper
from rce_fleet.mapping.gmapping.motion import motion_std, prior_information
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.gmapping.particles import (
    Ancestry,
    effective_number,
    entropy,
    normalized,
    systematic_sample,
)
from rce_fleet.mapping.occupancy_mapping import map_of
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.nodes.slam_gmapping import SlamGmappingNode, SlamGmappingParameters


def run(
    parameters: FilterParameters, seed: int = 0, number: int = 60
) -> tuple[NDArray[np.float64], ParticleMapper]:
    true, records = drive(number)
    mapper = ParticleMapper(parameters, seed=seed)
    for record in records:
        mapper.add(record)
    return true, mapper


QUICK = FilterParameters(particles=3, linear_update=0.2, angular_update=0.2, skip=1)


@pytest.mark.slow
def test_a_drive_is_mapped_better_than_by_odometry() -> None:
    true, mapper = run(QUICK)
    _, records = drive()
    odometry = np.array([record.odometry for record in records])
    drift = np.hypot(*(relative(odometry[0], odometry) - true)[:, :2].T).mean()
    filtered = np.hypot(*(mapper.trajectory() - true)[:, :2].T).mean()
    mapper.finish()
    refined = np.hypot(*(mapper.trajectory() - true)[:, :2].T).mean()
    assert drift > 2 * filtered
    assert filtered < 0.15
    assert refined < 0.12
    drawn = mapper.occupancy_map()
    assert (drawn.values_at(true[:, :2]) == 0).all()
    assert 300 < drawn.occupied.sum() < 900


@pytest.mark.slow
def test_the_same_seed_gives_the_same_map() -> None:
    first, second, other = (run(QUICK, seed, number=20)[1] for seed in (1, 1, 2))
    assert (first.trajectory() == second.trajectory()).all()
    assert (first.occupancy_map().data == second.occupancy_map().data).all()
    assert (first.trajectory() != other.trajectory()).any()


@pytest.mark.slow
def test_the_parameters_of_the_paper_give_a_map_by_odometry() -> None:
    parameters = FilterParameters(
        particles=1, srr=0, srt=0, str_=0, stt=0, minimum_score=10000, linear_update=0.2
    )
    _, mapper = run(parameters, number=20)
    _, records = drive(20)
    odometry = np.array([record.odometry for record in records])
    for _ in range(2):
        assert np.allclose(mapper.trajectory(), relative(odometry[0], odometry))
        mapper.finish()


@pytest.mark.slow
def test_a_map_can_begin_at_a_given_pose() -> None:
    """Everything is as if the map was moved there; cells differ where the grid falls otherwise."""
    start = (3.0, -2.0, 0.5)
    true, records = drive(30)
    found = GridFilter(QUICK, np.random.default_rng(0), start)
    for record in records:
        found.add(record)
    assert np.hypot(*(found.estimate - compose(np.array(start), true[-1]))[:2]) < 0.15
    assert map_of(found.store, found.best).values_at(compose(np.array(start), true)[:, :2]).max() == 0


@pytest.mark.slow
def test_scans_are_used_after_way_turn_or_time() -> None:
    _, records = drive()
    for parameters, used in (
        (FilterParameters(particles=1, linear_update=1e9, angular_update=1e9), 1),
        (FilterParameters(particles=1, linear_update=1e9, angular_update=1e9, temporal_update=10.0), 6),
        (FilterParameters(particles=1, linear_update=0.0), 60),
    ):
        mapper = ParticleMapper(parameters)
        for record in records:
            mapper.add(record)
        assert len(mapper.filter.path()) == used
        assert mapper.trajectory().shape == (60, 3)


@pytest.mark.slow
def test_scans_without_returns_are_bridged_by_odometry() -> None:
    _, records = drive()
    blind = [
        LaserRecord(r.index, r.time, np.full(n, np.nan), r.angle_min, r.angle_increment, 9.9, r.odometry)
        for r, n in zip(records, [0, BEAMS] * 30, strict=True)
    ]
    mapper = ParticleMapper(FilterParameters(particles=1, srr=0, srt=0, str_=0, stt=0))
    for record in blind:
        mapper.add(record)
    mapper.finish()
    odometry = np.array([record.odometry for record in records])
    assert np.allclose(mapper.trajectory(), relative(odometry[0], odometry))
    assert mapper.occupancy_map().unknown.all()


def test_a_mapper_without_scans_has_an_empty_map() -> None:
    mapper = ParticleMapper()
    mapper.finish()
    assert mapper.trajectory().shape == (0, 3)
    assert mapper.occupancy_map().unknown.all()


def test_motion_errs_as_in_gmapping() -> None:
    parameters = FilterParameters(srr=0.1, srt=0.2, str_=0.3, stt=0.4)
    assert np.allclose(motion_std(np.array((-2.0, 0.0, 0.5)), parameters), (0.35, 0.21, 0.6))
    turned = prior_information(np.array((0.0, np.pi / 2)), np.array((0.5, 0.25, 0.1)))
    assert np.allclose(turned[0], np.diag((4, 16, 100)))
    assert np.allclose(turned[1], np.diag((16, 4, 100)))


@given(st.lists(st.floats(-50, 0), min_size=1, max_size=40), st.floats(0, 1, exclude_max=True))
def test_resampling_keeps_the_share_of_weights(logs: list[float], draw: float) -> None:
    weights = normalized(np.array(logs), 0.1)
    chosen = systematic_sample(weights, draw)
    counts = np.bincount(chosen, minlength=len(weights))
    assert counts.sum() == len(weights)
    assert (np.abs(counts - weights * len(weights)) < 1 + 1e-6).all()


def test_effective_number_and_entropy() -> None:
    assert effective_number(np.full(4, 0.25)) == pytest.approx(4)
    assert effective_number(np.array((1.0, 0.0))) == pytest.approx(1)
    assert entropy(np.full(4, 0.25)) == pytest.approx(log(4))
    assert entropy(np.array((1.0, 0.0))) == 0


def test_ancestry_follows_resampled_particles() -> None:
    ways = Ancestry()
    ways.append(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    ways.choose(np.array([2, 2, 0]))
    ways.append(np.array([[5.0, 0, 0], [6, 0, 0], [7, 0, 0]]))
    ways.choose(np.array([1, 2, 2]))
    assert ways.path(0)[:, 0].tolist() == [2, 6]
    assert ways.path(1)[:, 0].tolist() == [0, 7]


@pytest.mark.slow
@pytest.mark.parametrize("resample_threshold", [0.0, 1.1])
def test_a_filter_without_the_way_keeps_one_entry(resample_threshold: float) -> None:
    """A node runs for months; the map is the same as with the way."""
    parameters = replace(QUICK, resample_threshold=resample_threshold)
    _, records = drive(30)
    whole = GridFilter(parameters, np.random.default_rng(0))
    short = GridFilter(parameters, np.random.default_rng(0), keeps_way=False)
    for record in records:
        whole.add(record)
        short.add(record)
        assert len(short.path()) == 1
    assert len(whole.path()) > 5
    assert np.array_equal(whole.path()[-1], short.path()[0])
    assert np.array_equal(whole.poses, short.poses)


def test_the_node_does_not_keep_the_way() -> None:
    parameters = SlamGmappingParameters(particles=1, linear_update=0.0, seed=1)
    node = SlamGmappingNode(ClockOnly(), parameters)  # type: ignore[arg-type] # it stands for one
    for record in drive(4)[1]:
        node._use(record)
    assert len(node._filter.path()) == 1


def test_headings_around_pi_have_a_small_covariance() -> None:
    """Else a robot that faces -x would count as lost."""
    found = GridFilter(FilterParameters(particles=4), np.random.default_rng(0))
    found.poses = np.array([(0.0, 1.0, 3.13), (0.2, 1.0, -3.13), (0.0, 1.0, 3.13), (0.2, 1.0, -3.13)])
    half = np.pi - 3.13
    assert found.covariance == pytest.approx(
        np.array([(0.01, 0, 0.1 * half), (0, 0, 0), (0.1 * half, 0, half**2)]), abs=1e-9
    )


def test_the_covariance_follows_the_weights() -> None:
    found = GridFilter(FilterParameters(particles=2), np.random.default_rng(0))
    found.poses = np.array([(0.0, 0.0, 0.1), (1.0, 0.0, -0.1)])
    found.weights = np.array([0.75, 0.25])
    assert found.covariance == pytest.approx(np.cov(found.poses.T, aweights=found.weights, ddof=0), abs=1e-6)


class ClockOnly:
    """Stands for a node where only the time is asked for."""

    seconds = 0.0

    def time(self) -> float:
        return self.seconds


def test_maps_are_drawn_on_when_time_jumps_back() -> None:
    """Else the next map would come when the time before is reached again."""
    clock = ClockOnly()
    parameters = SlamGmappingParameters(particles=1, linear_update=0.0, angular_update=0.0, seed=1)
    node = SlamGmappingNode(clock, parameters)  # type: ignore[arg-type] # it stands for one
    _, records = drive(4)
    drawn = []
    for clock.seconds, record in zip((1000.0, 1001.0, 3.0, 4.0), records, strict=True):
        node._use(record)
        drawn.append(node._map)
    assert drawn[1] is drawn[0]
    assert drawn[2] is not drawn[0]
    assert drawn[3] is drawn[2]
