"""Where a differential-drive robot comes to with given speeds, with its accelerations held."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose, Twist

    Floats = NDArray[np.float64]

CONTACT = 0.002
"""A pose is nearer to an obstacle than the present one if its clearance is less by more than this, metres."""


def roll_out(
    pose: Pose,
    twist: Twist,
    speeds: Floats,
    turn_rates: Floats,
    acceleration: tuple[float, float],
    times: tuple[int, float],
) -> tuple[Floats, Floats]:
    """Return the trajectories of a robot that changes its speeds to others as fast as it may.

    Each step is an arc of a circle, taken by its chord, which is exact.

    Args:
        pose: Where the robot is.
        twist: Its speeds now.
        speeds: Forward speeds to reach, shape (K,), metres per second.
        turn_rates: Turn rates to reach, shape (K,), radians per second.
        acceleration: Of the forward speed (m/s2) and of the turn rate (rad/s2).
        times: Number of steps T, and the length of a step in seconds.

    Returns:
        Poses after each step, shape (K, T, 3), and the distance driven until then, shape (K, T), metres.
    """
    count, dt = times
    after = np.arange(1, count + 1, dtype=np.float64) * dt
    v = _ramp(twist.speed, speeds, acceleration[0], np.asarray(after - dt / 2))
    w = _ramp(twist.turn_rate, turn_rates, acceleration[1], np.asarray(after - dt / 2))
    turned = np.cumsum(w * dt, axis=1)
    middle = pose.yaw + turned - w * dt / 2
    half = w * dt / 2
    chord = v * dt * np.sinc(half / np.pi)
    x = pose.x + np.cumsum(chord * np.cos(middle), axis=1)
    y = pose.y + np.cumsum(chord * np.sin(middle), axis=1)
    return np.stack((x, y, pose.yaw + turned), axis=2), np.cumsum(np.abs(v) * dt, axis=1)


def _ramp(now: float, wanted: Floats, acceleration: float, at: Floats) -> Floats:
    """Return speeds at times, shape (K, T), that change from ``now`` to ``wanted`` by an acceleration."""
    change = wanted[:, None] - now
    return np.asarray(now + np.sign(change) * np.minimum(np.abs(change), acceleration * at[None, :]))


def free_steps(clearances: Floats, margin: float, now: float) -> NDArray[np.intp]:
    """Return how many steps of trajectories keep their distance from obstacles, shape (K,).

    Args:
        clearances: Distance to the nearest obstacle after each step, shape (K, T), metres.
        margin: Distance to keep, metres.
        now: Clearance of the present pose. If that is below the margin already, the robot may move as long as
            it does not get nearer.
    """
    blocked = (clearances < margin) & (clearances < now - CONTACT)
    return np.asarray(np.where(blocked.any(axis=1), blocked.argmax(axis=1), clearances.shape[1]))


def stopping_distance(speed: Floats | float, deceleration: float, delay: float) -> Floats:
    """Return the distance until a robot stands that brakes after a delay, metres."""
    fast = np.abs(speed)
    return np.asarray(fast * delay + fast * fast / (2 * deceleration))
