"""The safety stage: stopping distances, late inputs, emergency stops, things that move."""

from __future__ import annotations

from dataclasses import replace
from math import cos, inf, nan, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.navigation import read_speed_limit
from rce_fleet.navigation.safety.limiter import VelocityLimiter, allowed_speed
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.navigation.safety.seen import Scan
from rce_fleet.simulation.lidar import LidarSpec, cast

BEAMS = 360
STEP = 2 * pi / BEAMS
HERE = Pose(0.0, 0.0, 0.0)
PARAMETERS = SafetyParameters(deceleration=1.0, delay=0.1, margin=0.05, walking_speed=0.0)
DISC = Footprint(0.2)


def scan(ranges: np.ndarray | float = inf, stamp: float = 0.0, sensor: Pose = HERE) -> Scan:
    full = np.broadcast_to(np.asarray(ranges, np.float64), (BEAMS,)).copy()
    return Scan(stamp, sensor, full, -pi, STEP, 0.05)


def circles(*shapes: tuple[float, float, float], at: Pose = HERE, stamp: float = 0.0) -> Scan:
    """Return the scan of round obstacles: x, y, radius."""
    spec = LidarSpec(BEAMS, 6.0)
    ranges = cast(spec, (at.x, at.y), at.yaw, np.empty((0, 4)), np.array(shapes).reshape(-1, 3))
    return scan(np.where(ranges < 6.0, ranges, inf), stamp, at)


def limiter(
    parameters: SafetyParameters = PARAMETERS, footprint: Footprint = DISC, seen: Scan | None = None
) -> VelocityLimiter:
    made = VelocityLimiter(parameters, footprint)
    made.take_pose(HERE, 0.0)
    made.take_scan(seen or scan())
    return made


def test_a_command_in_the_open_passes() -> None:
    stage = limiter()
    stage.take_command(Twist(0.5, 0.3), 0.0)
    assert stage.limit(0.0).twist == Twist(0.5, 0.3)
    assert stage.limit(0.0).reason == ""


def test_a_speed_limit_counts_until_it_ends() -> None:
    stage = limiter()
    stage.take_command(Twist(0.5, 0.3), 0.0)
    stage.speed_limit = read_speed_limit(0.2)
    slow = stage.limit(0.0).twist
    assert slow.speed == 0.2
    assert slow.turn_rate == pytest.approx(0.12)  # on the same arc
    stage.speed_limit = read_speed_limit(0.0)
    assert stage.limit(0.0).twist == Twist(0.5, 0.3)


@pytest.mark.parametrize("value", [-0.1, nan, inf])
def test_a_speed_limit_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="expected a speed in m/s"):
        read_speed_limit(value)


def test_an_obstacle_ahead_limits_the_speed() -> None:
    stage = limiter(seen=circles((0.7, 0.0, 0.1)))  # 0.4 m in front of the hull
    stage.take_command(Twist(2.0, 0.0), 0.0)
    verdict = stage.limit(0.0)
    free = 0.35  # without the margin
    assert verdict.twist.speed == pytest.approx(0.65)  # the highest speed that passes
    assert allowed_speed(free, 1.0, 0.1) > 0.65
    near = limiter(seen=circles((0.4, 0.0, 0.1)))
    near.take_command(Twist(0.65, 0.2), 0.0)
    verdict = near.limit(0.0)
    assert verdict.twist.speed == pytest.approx(allowed_speed(0.05, 1.0, 0.1), abs=0.03)
    assert verdict.twist.turn_rate == pytest.approx(0.2 * verdict.twist.speed / 0.65)
    assert "ahead" in verdict.reason


def test_an_obstacle_beside_the_way_does_not_matter() -> None:
    stage = limiter(seen=circles((0.5, 0.5, 0.1), (-0.4, 0.0, 0.1)))
    stage.take_command(Twist(0.6, 0.0), 0.0)
    assert stage.limit(0.0).twist == Twist(0.6, 0.0)


def test_the_robot_may_leave_an_obstacle_that_it_touches() -> None:
    stage = limiter(seen=circles((0.3, 0.0, 0.1)))
    for twist, passes in ((Twist(0.3, 0.0), False), (Twist(-0.3, 0.0), True), (Twist(0.0, 1.0), True)):
        stage.take_command(twist, 0.0)
        assert (stage.limit(0.0).twist == twist) is passes


free_distances = st.floats(0.0, 3.0)


@given(free_distances, st.floats(0.2, 3.0), st.floats(0.0, 0.5))
def test_the_allowed_speed_stops_exactly_in_time(free: float, deceleration: float, delay: float) -> None:
    speed = allowed_speed(free, deceleration, delay)
    assert speed * delay + speed**2 / (2 * deceleration) == pytest.approx(free, abs=1e-9)


@given(
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.05, 0.3)), min_size=1, max_size=6),
    st.floats(-1.0, 1.0),
    st.floats(-2.0, 2.0),
    st.floats(0.0, 0.3),
)
def test_a_stopping_distance_never_exceeds_the_free_one(
    shapes: list[tuple[float, float, float]], speed: float, turn_rate: float, age: float
) -> None:
    """Driving on for the delay and the scan's age and braking then, the hull touches nothing seen."""
    seen = circles(*(one for one in shapes if np.hypot(one[0], one[1]) > one[2] + 0.3))
    stage = limiter(seen=seen)
    stage.take_command(Twist(speed, turn_rate), 0.0)
    stage.take_pose(HERE, age)
    twist = stage.limit(age).twist
    assert abs(twist.speed) <= abs(speed) + 1e-9
    x = y = yaw = 0.0
    dt, v, w, t = 0.005, twist.speed, twist.turn_rate, 0.0
    points = seen.hits
    while abs(v) > 1e-9:
        x, y, yaw = x + v * dt * cos(yaw + w * dt / 2), y + v * dt * sin(yaw + w * dt / 2), yaw + w * dt
        t += dt
        if t > 0.1 + age:  # the robot brakes on its arc
            rest = max(0.0, abs(v) - 1.0 * dt) / abs(v)
            v, w = v * rest, w * rest
        if len(points):
            assert np.hypot(*(points - (x, y)).T).min() >= 0.2 - 0.01


@pytest.mark.parametrize(("now", "reason"), [(0.6, "no command"), (0.4, "scan"), (0.45, "no transform")])
def test_late_inputs_stop_the_robot(now: float, reason: str) -> None:
    parameters = SafetyParameters(scan_timeout=0.3, command_timeout=0.5, transform_timeout=0.4)
    stage = limiter(parameters)
    stage.take_command(Twist(0.3, 0.0), 0.0)
    assert stage.limit(0.1).twist == Twist(0.3, 0.0)
    if "transform" in reason:
        stage.take_scan(scan(stamp=now))
    verdict = stage.limit(now)
    assert verdict.stopped
    assert verdict.twist == Twist()
    assert reason in verdict.reason


def test_without_any_scan_the_robot_stands() -> None:
    stage = VelocityLimiter(PARAMETERS, DISC)
    stage.take_command(Twist(0.3, 0.0), 0.0)
    assert stage.limit(0.0).reason == "no scan yet"


def test_an_emergency_stop_holds_until_released() -> None:
    stage = limiter()
    stage.take_command(Twist(0.3, 0.0), 0.0)
    stage.stop("button")
    stage.take_command(Twist(0.3, 0.0), 0.1)
    assert stage.limit(0.1).twist == Twist()
    assert stage.limit(0.1).reason == "button"
    stage.release()
    assert stage.limit(0.1).twist == Twist()  # a command from before does not count
    stage.take_command(Twist(0.3, 0.0), 0.2)
    assert stage.limit(0.2).twist == Twist(0.3, 0.0)


def test_a_stop_is_released_only_on_its_own_way() -> None:
    stage = limiter()
    stage.stop("by a person", "service")
    stage.stop("by the station", "topic")
    stage.release("topic")
    stage.take_command(Twist(0.3, 0.0), 0.0)
    assert stage.limit(0.0).reason == stage.emergency == "by a person"
    stage.release("service")
    stage.release("topic")
    stage.take_command(Twist(0.3, 0.0), 0.1)
    assert (stage.emergency, stage.limit(0.1).twist) == ("", Twist(0.3, 0.0))


@pytest.mark.parametrize("twist", [Twist(nan, 0.0), Twist(0.1, inf)])
def test_a_command_that_is_not_finite_stops_the_robot(twist: Twist) -> None:
    stage = limiter()
    stage.take_command(twist, 0.0)
    assert stage.limit(0.0).twist == Twist()


def test_backwards_without_a_view_the_robot_is_slow() -> None:
    ahead = Scan(0.0, HERE, np.full(60, inf), -0.5, 1.0 / 60, 0.45)
    stage = limiter(seen=ahead)
    stage.take_command(Twist(-0.4, 0.0), 0.0)
    assert stage.limit(0.0).twist.speed == pytest.approx(-0.1)
    stage.take_command(Twist(0.4, 0.0), 0.0)
    assert stage.limit(0.0).twist.speed == pytest.approx(0.4)


def test_something_that_moves_nearby_slows_the_robot() -> None:
    """A person steps into space that was free; a box that stands at the same place does not slow it."""
    parameters = SafetyParameters(margin=0.05, walking_speed=1.0)
    for before, slow in ((circles((1.1, 1.2, 0.2)), True), (circles((1.1, 0.6, 0.2)), False)):
        stage = VelocityLimiter(parameters, DISC)
        stage.take_pose(HERE, 0.3)
        stage.take_scan(before)
        stage.take_scan(circles((1.1, 0.6, 0.2), stamp=0.3))
        stage.take_command(Twist(0.6, 0.0), 0.3)
        verdict = stage.limit(0.3)
        assert (verdict.twist.speed < 0.55) is slow
        assert ("moves" in verdict.reason) is slow


def test_points_below_the_shortest_range_are_remembered() -> None:
    """A depth camera does not see what is nearer than 0.45 m; the stage remembers what it saw there."""

    def ahead(distance: float, x: float, stamp: float) -> Scan:
        angles = -0.5 + np.arange(60) / 60
        ranges = distance / np.cos(angles)
        ranges[ranges < 0.45] = nan
        return Scan(stamp, Pose(x, 0.0, 0.0), ranges, -0.5, 1 / 60, 0.45)

    stage = VelocityLimiter(PARAMETERS, DISC)
    for step in range(5):
        x = step * 0.1
        stage.take_pose(Pose(x, 0.0, 0.0), step * 0.1)
        stage.take_scan(ahead(0.65 - x, x, step * 0.1))
    stage.take_command(Twist(0.5, 0.0), 0.4)
    assert stage.limit(0.4).twist.speed == 0.0  # the wall is 0.25 m away, the hull 0.05


def test_odometry_that_jumps_forgets_what_was_seen() -> None:
    stage = limiter()
    stage.take_command(Twist(0.3, 0.0), 0.0)
    stage.take_pose(Pose(5.0, 0.0, 0.0), 0.1)
    assert stage.limit(0.1).reason == "no scan yet"


def test_a_polygon_needs_room_to_turn() -> None:
    plank = Footprint(corners=((0.5, 0.1), (-0.5, 0.1), (-0.5, -0.1), (0.5, -0.1)))
    stage = limiter(footprint=plank, seen=circles((0.4, 0.25, 0.05)))
    stage.take_command(Twist(0.0, 1.0), 0.0)
    assert stage.limit(0.0).twist.turn_rate < 0.8
    stage.take_command(Twist(0.0, -1.0), 0.0)
    assert stage.limit(0.0).twist.turn_rate == -1.0


def test_the_robots_own_body_is_no_obstacle() -> None:
    """A mast before the lidar is inside the outline; a box at the hull is not."""
    stage = limiter(seen=circles((0.1, 0.0, 0.02)))
    stage.take_command(Twist(0.5, 0.0), 0.0)
    assert stage.limit(0.0).twist == Twist(0.5, 0.0)


def test_time_that_jumps_back_begins_anew() -> None:
    stage = VelocityLimiter(PARAMETERS, DISC)
    stage.take_pose(HERE, 100.0)
    stage.take_scan(circles((0.4, 0.0, 0.1), stamp=100.0))
    stage.take_pose(HERE, 1.0)
    stage.take_scan(scan(stamp=1.0))
    stage.take_command(Twist(0.5, 0.0), 1.0)
    assert stage.limit(1.0).twist == Twist(0.5, 0.0)


PLANK = Footprint(corners=((0.5, 0.1), (-0.5, 0.1), (-0.5, -0.1), (0.5, -0.1)))


@pytest.mark.parametrize("speed", [0.0, 0.002, -0.002, 0.05, 0.1])
def test_a_polygon_that_creeps_needs_room_to_turn(speed: float) -> None:
    """The corners swing until the turn has ended, which a small forward speed does not shorten."""
    seen = circles((0.4, 0.28, 0.05), (-0.4, -0.28, 0.05))
    stage = limiter(footprint=PLANK, seen=seen)
    stage.take_command(Twist(speed, 2.0), 0.0)
    rate = stage.limit(0.0).twist.turn_rate
    assert 0.0 < rate < 1.2
    parameters = stage.parameters
    angle = rate * parameters.delay + rate**2 / (2 * parameters.angular_deceleration)
    yaws = np.linspace(0.0, angle, 50)
    poses = np.stack((np.zeros(50), np.zeros(50), yaws), axis=1)
    assert PLANK.clearance(poses, seen.hits).min() >= parameters.margin - 0.02


def test_clocks_set_back_stop_the_robot_until_news() -> None:
    """Else the last command counted until the time before came again, with nothing behind it."""
    stage = VelocityLimiter(PARAMETERS, DISC)

    def take(now: float) -> None:
        stage.take_pose(HERE, now)
        stage.take_scan(scan(stamp=now))
        stage.take_command(Twist(0.5, 0.0), now)

    take(1000.0)
    assert stage.limit(1000.0).twist == Twist(0.5, 0.0)
    for now in (900.0, 900.1, 950.0, 1000.0):
        assert stage.limit(now).stopped
    take(1000.1)
    assert stage.limit(1000.1).twist == Twist(0.5, 0.0)
    stage.limit(900.0)
    take(900.1)
    assert stage.limit(900.1).twist == Twist(0.5, 0.0)


def test_scans_with_the_same_stamp_are_both_taken() -> None:
    stage = limiter()
    for stamp in (0.0, 0.1, 0.3, 0.5, 0.9):
        stage.take_scan(scan(5.0 - stamp, stamp))
    assert stage.seen.newest is not None
    assert stage.seen.newest.stamp == 0.9


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_where_beams_tell_nothing_the_robot_is_slow(speed: float) -> None:
    """A lidar that is covered sends NaN, or ranges below its least one."""
    stage = limiter(seen=scan(nan))
    stage.take_command(Twist(speed, 0.0), 0.0)
    verdict = stage.limit(0.0)
    assert abs(verdict.twist.speed) == PARAMETERS.unseen_speed
    assert "no scan tells" in verdict.reason
    ranges = np.full(BEAMS, inf)
    ranges[::2] = nan  # single echoes were lost
    seeing = limiter(seen=scan(ranges))
    seeing.take_command(Twist(speed, 0.0), 0.0)
    assert seeing.limit(0.0).twist == Twist(speed, 0.0)


@pytest.mark.parametrize(("sensor", "allowed"), [(HERE, 0.5), (Pose(0.0, 0.0, pi), PARAMETERS.unseen_speed)])
def test_a_driver_may_send_nan_where_nothing_is(sensor: Pose, allowed: float) -> None:
    """As a parameter says; a direction beside the scan, here behind a sensor of 180 degrees, is not seen."""
    half = Scan(0.0, sensor, np.full(BEAMS // 2, nan), -pi / 2, STEP, 0.05)
    stage = limiter(replace(PARAMETERS, missing_is_free=True), seen=half)
    stage.take_command(Twist(0.5, 0.0), 0.0)
    assert stage.limit(0.0).twist.speed == allowed
