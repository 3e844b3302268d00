"""Drive, odometry and battery of simulated robots."""

from __future__ import annotations

from dataclasses import replace
from math import cos, inf, nan, pi, sin

import numpy as np
import pytest

from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.battery import Battery, BatterySpec
from rce_fleet.simulation.drive import Drive, DriveSpec
from rce_fleet.simulation.lidar import LidarSpec
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.noise import EstimateSpec
from rce_fleet.simulation.odometry import STRIDE, STRIDE_TURN, Odometry, OdometrySpec
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import Dock, WorldSpec

STEP = 0.02


def drive_of(**spec: float) -> Drive:
    return Drive(replace(DriveSpec(), **spec), np.random.default_rng(0))  # type: ignore[arg-type]  # no bool


# Drive


def test_speeds_change_within_the_limits() -> None:
    limits = {"speed": 0.65, "turn_rate": 2.0, "acceleration": 1.0, "turn_acceleration": 3.0}
    drive = drive_of(deceleration=2.0, **limits)
    drive.command(Twist(5.0, -9.0))
    seen = []
    for number in range(200):
        if number == 100:
            drive.command(Twist(-5.0, 9.0))
        drive.step(STEP)
        seen.append(drive.wheels)
    speeds, turns = np.array([(twist.speed, twist.turn_rate) for twist in seen]).T
    assert np.diff(speeds).max() <= 1.0 * STEP + 1e-9
    assert np.diff(speeds).min() == pytest.approx(-2.0 * STEP), "braking"
    assert np.abs(np.diff(turns)).max() == pytest.approx(3.0 * STEP)
    assert (speeds.max(), turns.min()) == pytest.approx((0.65, -2.0))
    assert (speeds.min(), turns.max()) == pytest.approx((-0.65, 2.0))


def test_a_robot_without_commands_stops() -> None:
    drive = drive_of(command_timeout=0.6, acceleration=10.0, deceleration=10.0)
    drive.command(Twist(0.5))
    moving = []
    for _ in range(50):
        drive.step(STEP)
        moving.append(drive.wheels.speed > 0)
    assert moving.index(False) * STEP == pytest.approx(0.64, abs=0.05)
    assert not any(moving[moving.index(False) :])


def test_slip_shortens_the_way_and_odometry_misses_it() -> None:
    model = RobotModel(
        drive=DriveSpec(slip=0.1, wheels_stall=False), odometry=OdometrySpec(alpha1=0.0, alpha3=0.0)
    )
    world = World(GridMap(), WorldSpec(model=model))
    robot = world.add_robot("R", 0)
    robot.drive(Twist(0.5))
    world.step(4.0)
    assert robot.odometry.x == pytest.approx(2.0)
    assert robot.distance == pytest.approx(1.8)


def test_slip_varies_around_its_mean() -> None:
    drive = drive_of(slip=0.05, slip_noise=0.02, slip_memory=0.1)
    slips = []
    for _ in range(20_000):
        drive.step(STEP)
        slips.append(drive.slip)
    assert np.mean(slips) == pytest.approx(0.05, abs=0.003)
    assert np.std(slips) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("stall", [True, False])
def test_wheels_spin_or_stall_at_a_wall(stall: bool) -> None:
    spec = OdometrySpec(alpha1=0.0, alpha3=0.0)
    world = World(GridMap(), WorldSpec(model=RobotModel(drive=DriveSpec(wheels_stall=stall), odometry=spec)))
    robot = world.add_robot("R", 0, pi)
    robot.drive(Twist(0.5))
    world.step(4.0)
    assert robot.pose.x == pytest.approx(0.22, abs=0.01)
    assert robot.odometry.x == pytest.approx(0.28 if stall else 2.0, abs=0.02)
    assert world.touched("R") == pytest.approx([0.0], abs=0.01)


# Odometry


def moved(spec: OdometrySpec, way: float, turn: float, seed: int, steps: int = 20) -> Pose:
    odometry = Odometry(spec, np.random.default_rng(seed))
    for _ in range(steps):
        odometry.update(way / steps, turn / steps)
    return odometry.pose


@pytest.mark.slow
@pytest.mark.parametrize("steps", [5, 40])
def test_odometry_has_the_variances_of_the_alpha_model(steps: int) -> None:
    """One update of amcl: straight on, then on the spot; whatever the time step is."""
    spec = OdometrySpec(alpha1=0.01, alpha2=0.02, alpha3=0.03, alpha4=0.04)
    straight = [moved(spec, STRIDE, 0.0, seed, steps) for seed in range(2000)]
    turned = [moved(spec, 0.0, STRIDE_TURN, seed, steps) for seed in range(2000)]
    assert np.var([pose.x for pose in straight]) == pytest.approx(0.03 * STRIDE**2, rel=0.12)
    assert np.var([pose.yaw for pose in straight]) == pytest.approx(2 * 0.02 * STRIDE**2, rel=0.12)
    assert np.var([pose.yaw for pose in turned]) == pytest.approx(0.01 * STRIDE_TURN**2, rel=0.12)
    ways = [pose.x * cos(pose.yaw / 2) + pose.y * sin(pose.yaw / 2) for pose in turned]
    assert np.var(ways) == pytest.approx(0.04 * STRIDE_TURN**2, rel=0.25)
    assert np.mean([pose.x for pose in straight]) == pytest.approx(STRIDE, abs=0.003)


def test_biases_stay_the_same_for_a_robot() -> None:
    spec = OdometrySpec(alpha1=0.0, alpha3=0.0, distance_bias=0.02, turn_bias=0.03, drift=0.01)
    ways = np.array([moved(spec, 1.0, 0.0, seed).yaw for seed in range(1000)])
    assert np.std(ways) == pytest.approx(0.01, rel=0.1)
    assert moved(spec, 1.0, 0.0, 5) == moved(spec, 1.0, 0.0, 5)
    turns = [moved(spec, 0.0, 1.0, seed).yaw - 1.0 for seed in range(1000)]
    assert np.std(turns) == pytest.approx(0.03, rel=0.1)
    assert moved(spec, 2.0, 0.0, 5).yaw == pytest.approx(2 * moved(spec, 1.0, 0.0, 5).yaw)


# Battery

SPEC = BatterySpec(
    capacity=10.0, idle=4.0, computing=20.0, computing_load=0.5, drive=10.0, turn=2.0, charging=30.0
)


def test_energy_is_power_times_time() -> None:
    battery = Battery(SPEC)
    for _ in range(3600):
        battery.step(0.1, -0.5, 1.0)
    assert battery.power == pytest.approx(4.0 + 10.0 + 5.0 + 2.0)
    assert battery.energy == pytest.approx(10.0 - 21.0 * 360 / 3600)
    assert battery.voltage == pytest.approx(13.2 + battery.share * 3.4)
    battery.computing_load = 0.0
    battery.step(0.1, 0.0, 0.0)
    assert battery.power == pytest.approx(4.0)


def test_an_empty_battery_stops_the_robot_and_a_dock_fills_it() -> None:
    spec = BatterySpec(capacity=0.01, idle=36.0, charging=72.0)
    docks = (Dock(2.5, 0.5, reach=0.3),)
    world = World(GridMap(), WorldSpec(model=RobotModel(battery=spec), docks=docks))
    robot = world.add_robot("R", 0)
    robot.drive(Twist(0.5))
    world.step(3.0)
    assert robot.battery.empty
    assert robot.pose.x == pytest.approx(1.0, abs=0.02), "after one second of 36 W"
    world.move_robot("R", Pose(2.4, 0.5, 0.0))
    world.step(0.5)
    assert robot.battery.charging
    assert robot.battery.energy == pytest.approx(36.0 * 0.5 / 3600, rel=0.05)
    world.step(5.0)
    assert robot.battery.full


def test_the_default_battery_never_gets_empty() -> None:
    battery = Battery(BatterySpec())
    battery.step(1e9, 1.0, 1.0)
    assert (battery.share, battery.empty, battery.energy) == (1.0, False, inf)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DriveSpec(speed=0.0), "speed must be positive"),
        (lambda: DriveSpec(slip=1.0), "slip must be within"),
        (lambda: OdometrySpec(alpha2=-1.0), "not negative"),
        (lambda: BatterySpec(charge=1.5), "charge must be within 0 .. 1"),
        (lambda: RobotModel(sensor="radar"), "no sensor 'radar'; its sensors: lidar"),
        (lambda: RobotModel(radius=-1.0), "radius must be within"),
        (lambda: RobotModel(radius=nan), "radius must be within"),
        (lambda: RobotModel(mass=inf), "mass must be within"),
        (lambda: RobotModel(mass=1e-300), "mass must be within"),
        (lambda: DriveSpec(slip_noise=nan), "slip_noise finite"),
        (lambda: DriveSpec(slip_noise=inf), "slip_noise finite"),
        (lambda: OdometrySpec(alpha1=nan), "alpha1 to alpha4 must be finite"),
        (lambda: OdometrySpec(drift=inf), "biases and drift must be finite"),
        (lambda: BatterySpec(idle=nan), "powers must be finite"),
        (lambda: BatterySpec(voltage_full=inf), "voltages must be"),
        (lambda: EstimateSpec(position=nan), "position and heading must be finite"),
        (lambda: LidarSpec(noise=nan), "noise_squared and quantum must be finite"),
        (lambda: LidarSpec(x=nan), "x, y, z and yaw must be finite"),
        (lambda: LidarSpec(beams=1_000_000_000), "beams must be within"),
    ],
)
def test_impossible_parts_are_refused(make: object, words: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=words):
        make()


def test_speeds_that_are_not_finite_count_as_0() -> None:
    """A velocity that is not a number drove the robot at its highest speed."""
    drive = Drive(DriveSpec(speed=0.5, turn_rate=1.0), np.random.default_rng(0))
    drive.command(Twist(nan, inf))
    drive.step(0.1)
    assert drive.wheels == Twist()
