"""Range sensors against pymunk's ray queries, and their noise."""

from __future__ import annotations

from math import cos, inf, pi, radians, sin

import numpy as np
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.box import BoxSpec
from rce_fleet.simulation.lidar import Floats, LidarSpec, cast_many, measure
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import WorldSpec

CAMERA = LidarSpec(
    beams=160, field_of_view=radians(58), min_range=0.45, max_range=10.0, noise=0.0, x=0.1, y=-0.05, yaw=0.2
)
LIDAR = LidarSpec(beams=90, noise=0.0)


def oracle(world: World, robot: str) -> Floats:
    """The exact scan of a robot, beam by beam with pymunk."""
    seer = world.robots[robot]
    spec = seer.model.lidar
    x, y, yaw = spec.poses(seer.pose.as_array()[None])[0]
    seer.shape.filter = pymunk.ShapeFilter(categories=1)
    seen = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ 1)
    ranges = np.full(spec.beams, spec.max_range)
    for beam, angle in enumerate(spec.angles() + yaw):
        end = (x + spec.max_range * cos(angle), y + spec.max_range * sin(angle))
        hit = world.space.segment_query_first((x, y), end, 0.0, seen)
        if hit is not None:
            ranges[beam] = hit.alpha * spec.max_range
    seer.shape.filter = pymunk.ShapeFilter()
    return ranges


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([CAMERA, LIDAR]))
def test_sensors_see_what_pymunk_sees(seed: int, spec: LidarSpec) -> None:
    """Walls, turned boxes and robots of two kinds, all sensors of a kind at once."""
    rng = np.random.default_rng(seed)
    cells = [int(cell) for cell in rng.choice(64, 14, replace=False)]
    model = RobotModel(sensors={"lidar": spec})
    world = World(GridMap(blocked=frozenset(cells[:4])), WorldSpec(model=model), seed=seed)
    for number, cell in enumerate(cells[4:8]):
        world.add_robot(f"R{number}", cell, float(rng.uniform(-pi, pi)))
    for number, cell in enumerate(cells[8:]):
        pose = Pose(*world.grid.centre(cell), float(rng.uniform(-pi, pi)))
        world.put_box(f"box{number}", BoxSpec(pose, float(rng.uniform(0.1, 0.6)), 0.3))
    world.space.reindex_static()
    for robot, ranges in world.scans(world.robots).items():
        exact = oracle(world, robot)
        reported = np.where(exact >= spec.max_range, inf, np.where(exact < spec.min_range, np.nan, exact))
        # At a corner rounding decides whether a beam just hits or just misses.
        wrong = ~np.isclose(ranges, reported, atol=1e-6, equal_nan=True)
        assert np.count_nonzero(wrong) <= 2, np.nonzero(wrong)


def test_a_field_of_view_ends_at_its_beams() -> None:
    spec = LidarSpec(beams=5, field_of_view=pi / 2, max_range=3.0)
    assert spec.angles() == pytest.approx([-pi / 4, -pi / 8, 0, pi / 8, pi / 4])
    around = np.array([[1, -2, 1, 2], [-1, -2, -1, 2]], np.float64)
    (ranges,) = cast_many(spec, np.array([[0.0, 0.0, 0.0]]), around, np.empty((0, 3)))
    assert ranges == pytest.approx(1 / np.cos(spec.angles()))
    (behind,) = cast_many(spec, np.array([[0.0, 0.0, pi]]), around[:1], np.empty((0, 3)))
    assert (behind == 3.0).all()


def test_noise_grows_with_the_range() -> None:
    spec = LidarSpec(beams=20_000, max_range=10.0, noise=0.01, noise_squared=0.004)
    rng = np.random.default_rng(0)
    for away in (1.0, 4.0):
        ranges = measure(spec, np.full(spec.beams, away), rng)
        assert np.std(ranges) == pytest.approx(0.01 + 0.004 * away**2, rel=0.05)
        assert np.mean(ranges) == pytest.approx(away, abs=0.002)


def test_quantum_drop_outs_and_limits() -> None:
    spec = LidarSpec(beams=10_000, min_range=0.5, max_range=4.0, noise=0.02, quantum=0.05, drop_outs=0.1)
    rng = np.random.default_rng(0)
    ranges = measure(spec, np.full(spec.beams, 2.0), rng)
    assert np.isinf(ranges).mean() == pytest.approx(0.1, abs=0.01)
    steps = ranges[np.isfinite(ranges)] / 0.05
    assert steps == pytest.approx(np.round(steps))
    assert np.isinf(measure(spec, np.full(spec.beams, 4.0), rng)).all()
    near = measure(spec, np.full(spec.beams, 0.3), rng)
    assert (np.isnan(near) | np.isinf(near)).all()


def test_beams_pass_through_glass() -> None:
    spec = LidarSpec(beams=400, noise=0.0, glass_returns=0.25, max_range=9.0)
    world = World(GridMap(), WorldSpec(model=RobotModel(sensors={"lidar": spec})))
    world.add_robot("R", 27)
    x, y = world.grid.centre(27)
    world.put_box("pane", BoxSpec(Pose(x + 1.0, y, 0.0), 0.02, 2.0, glass=True))
    ranges = world.scan("R")[190:211]
    glass = np.count_nonzero(ranges < 1.2)
    assert 0 < glass < len(ranges)
    assert (ranges[ranges > 1.2] > 4.0).all(), "the wall behind"
    opaque = RobotModel(sensors={"lidar": LidarSpec(noise=0.0)})
    world.place_robot("S", Pose(x, y - 1.0, pi / 4), opaque)
    assert np.nanmin(world.scan("S")) < 1.0


def test_a_scan_does_not_depend_on_who_reads_it() -> None:
    def scan(reads: int) -> Floats:
        world = World(GridMap(), seed=4)
        world.add_robot("R", 0)
        world.add_robot("S", 9)
        for _ in range(reads):
            world.scan("R")
            world.step()
        world.step(0.2 - world.time)
        return world.scan("R")

    np.testing.assert_array_equal(scan(0), scan(3))
    np.testing.assert_array_equal(scan(0), scan(5))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"beams": 1}, "beams must be within 2"),
        ({"field_of_view": 7.0}, "field_of_view"),
        ({"min_range": 3.0, "max_range": 2.0}, "min_range < max_range"),
        ({"drop_outs": 1.5}, "probabilities"),
        ({"rate": 0.0}, "rate must be positive"),
    ],
)
def test_impossible_sensors_are_refused(wrong: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        LidarSpec(**wrong)  # type: ignore[arg-type]  # numbers of both kinds
