"""The energy that a robot takes for a task, by the model of a TurtleBot 2 in ``rce_fleet/drivers/models``.

    energy = idle * T + computing * L * T + drive * S + turn * A

with the watts of the model's battery, as the simulated battery counts: ``idle`` (electronics and sensors,
4.5 W), ``computing`` (netbook at full load, beyond idle, 18 W), ``drive`` (12 W for each m/s) and ``turn``
(2 W for each rad/s). T is the task's time, S the way in metres, A what the robot turned in radians, and L the
load of the netbook: what its programs used of the share of a core that stands for it, 0 .. 1.

The model has no term for the radio: to send 40 kB/s by wireless LAN takes some tenths of a watt more than to
listen. Its watts are typical ones of such parts, not measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rce_fleet.simulation.battery import BatterySpec


class Effort(NamedTuple):
    """What a robot did for a task.

    Attributes:
        seconds: How long.
        metres: The way that it drove, forward and backward.
        radians: What it turned, to both sides.
        load: Of its computer, 0 .. 1.
    """

    seconds: float
    metres: float
    radians: float
    load: float


def energy_of(effort: Effort, battery: BatterySpec) -> float:
    """Return the energy that an effort takes out of a battery, joules."""
    standing = battery.idle + battery.computing * min(1.0, effort.load)
    return standing * effort.seconds + battery.drive * effort.metres + battery.turn * effort.radians
